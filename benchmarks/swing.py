"""A pendulum's swing out and back as given samples, for the configuration of the simulated one."""

from pathlib import Path

import numpy as np

from nlsid_core.arrays import FloatArray

ROOT = Path(__file__).resolve().parents[1]
HEIGHT, SECONDS, PERIOD = 0.25, 1.2, 0.01


def swing() -> FloatArray:
    """(N + 1, 2): out by HEIGHT rad and back to rest where it began, in SECONDS s."""
    t = np.arange(round(SECONDS / PERIOD) + 1) * PERIOD
    phase = 2 * np.pi * t / SECONDS
    rate = HEIGHT / 2 * 2 * np.pi / SECONDS
    return np.stack([HEIGHT / 2 * (1 - np.cos(phase)), rate * np.sin(phase)], axis=1)


def swing_config(folder: Path) -> Path:
    """config/pendulum.yaml with the swing in the place of its motion, and shorter recordings."""
    np.savetxt(folder / "swing.csv", swing(), delimiter=",", header="angle,rate", comments="")
    text = (ROOT / "config" / "pendulum.yaml").read_text()
    start, end = text.index("  start:"), text.index("  input_weight:")
    text = text[:start] + "  samples: swing.csv\n" + text[end:]
    for given, wanted in {"seconds: 60.0": "seconds: 20.0", "runs: 30": "runs: 20"}.items():
        assert given in text
        text = text.replace(given, wanted)
    path = folder / "swing.yaml"
    path.write_text(text)
    return path
