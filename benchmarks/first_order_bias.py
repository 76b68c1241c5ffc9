"""Figure 4.1: what output noise does to the pole of a first-order model, by method.

python -m benchmarks.first_order_bias [--trials N] [--json]

x(t) = 0.9 x(t-1) + w(t), 5000 samples, white noise on x at a signal-to-noise ratio in dB; the mean
estimated pole of the robust simulation error (RSE, the input's gain known as in thesis 4.2.2; and
iterated, the gain free), the robust identification error (RIE), least squares (EE), and the RIE
without bias from two repeats. Beside them Proposition 3.2, which is what the RIE tends to. Golden:
RSE/RIE/EE measured for this system.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json

import numpy as np
from scipy.signal import lfilter

from benchmarks.machine import describe
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.identification import Polynomial
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.polynomial.moment_rie import minimise_moment_rie
from nlsid_core.identification.polynomial.moments import Offsets, plain_moments, repeated_moments
from nlsid_core.identification.polynomial.rows import build_state_affine_rows

POLE, SAMPLES = 0.9, 5000
LEVELS = (0, 5, 10, 15, 20, 30)  # dB
OFFSETS = Offsets(0.0, np.zeros(1))
CURVES = ("rse", "rse_iterated", "rie", "proposition_3_2", "ee", "rie_moments")
GOLDEN = {
    10: (0.878, 0.0, 0.818),
    15: (0.896, 0.445, 0.872),
    20: (0.899, 0.729, 0.891),
    30: (0.900, 0.881, 0.899),
}


def proposition_3_2(pole: float, snr: float) -> float:
    """The pole that minimises the asymptotic RIE at this signal-to-noise power ratio."""
    room = 1.0 - abs(pole)
    return float(np.sign(pole)) * max(0.0, (snr * abs(pole) * room - 1.0) / (1.0 + snr * room))


def trial(level: float, rng: np.random.Generator) -> dict[str, float]:
    """Poles estimated from one realisation at this level in dB."""
    w = rng.standard_normal(SAMPLES)
    x: FloatArray = lfilter([1.0], [1.0, -POLE], w)
    power = 1.0 / (1.0 - POLE**2)
    noise = np.sqrt(power / 10 ** (level / 10))
    t = np.arange(SAMPLES, dtype=np.float64)
    runs = [
        Trajectory(t=t, y=x + noise * rng.standard_normal(SAMPLES), u=w, name=f"run {k}")
        for k in (1, 2)
    ]
    y = runs[0].y[:, 0]
    known = next(robust_simulation_error(_known_gain(y, w), iterations=1)).theta
    rows = build_state_affine_rows(Dataset((runs[0],)), Polynomial(1, (0,))).rows
    *_, last = robust_simulation_error(rows, iterations=4)
    model_class = Polynomial(1, (0,), set="3.8")
    plain = plain_moments(runs[:1], model_class, OFFSETS)
    clean = repeated_moments([runs], model_class, OFFSETS)
    identification, unbiased = (
        float(minimise_moment_rie(m, model_class, runs[0], OFFSETS).model.a[0])
        for m in (plain, clean)
    )
    columns = np.column_stack([y[:-1], w[1:]])
    return {
        "rse": float(-known[1] / known[0]),
        "rse_iterated": float(-last.theta[1] / last.theta[0]),
        "rie": identification,
        "ee": float(np.linalg.lstsq(columns, y[1:], rcond=None)[0][0]),
        "rie_moments": unbiased,
    }


def _known_gain(y: FloatArray, w: FloatArray) -> Rows:
    """e x(t) = f x(t-1) + e w(t): rows t = 1 … of e(y(t) - w(t)) - f y(t-1), without right side."""
    lagged = np.ones(len(y) - 1)
    lagged[0] = 0.0  # the first row's lag is measured
    return Rows(
        offsets=(0, 1),
        weights=np.asfortranarray(np.column_stack([np.ones(len(y) - 1), lagged])),
        errors=np.asfortranarray(np.column_stack([y[1:] - w[1:], y[:-1]])),
        Q=np.zeros((len(y) - 1, 0)),
        identity=np.array([1.0, 0.0]),
    )


def measure(trials: int) -> dict[str, dict[str, float]]:
    """Mean poles by level."""
    keys = {}
    for level in LEVELS:
        found = [trial(level, np.random.default_rng([level, k])) for k in range(trials)]
        means = {name: float(np.mean([f[name] for f in found])) for name in found[0]}
        means["proposition_3_2"] = proposition_3_2(POLE, 10 ** (level / 10))
        keys[f"{level}_db"] = means
    return keys


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    keys = measure(arguments.trials)
    print(f"mean pole over {arguments.trials} trials, true {POLE}, {describe()}\n")
    print(f"{'SNR [dB]':>9s}" + "".join(f"{c:>17s}" for c in CURVES) + "  golden RSE/RIE/EE")
    for level in LEVELS:
        row = "".join(f"{keys[f'{level}_db'][c]:17.3f}" for c in CURVES)
        golden = GOLDEN.get(level)
        beside = "/".join(f"{g:.3f}" for g in golden) if golden else "-"
        print(f"{level:9d}{row}  {beside}")
    print("\nBelow about 7 dB the first bound of the RSE is worse than least squares.")
    if arguments.json:
        print(json.dumps(keys))


if __name__ == "__main__":
    main()
