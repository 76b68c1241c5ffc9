"""The chain in Python: the F1TENTH bags to a proved model, a proved tube and a monitor."""

from bags.samples import f1tenth
from nlsid import Grid, OutputTube, Polynomial, Status, design, identify, read_bags
from nlsid_core.identification import simulation_percent

TEST = [f"trial_{k}" for k in ("05", "11", "16", "22", "27", "33", "38", "41")]
SPEED, COMMAND = "/odom:twist.twist.linear.x", "/cmd_vel:twist.linear.x"


def run() -> tuple[dict[str, float], dict[str, float]]:
    """(computed, known): the test error in % and how many test trials stay inside."""
    dataset = read_bags(f1tenth(), responses=[SPEED], excitations=[COMMAND], grid=Grid(max_gap=0.1))
    train, test = dataset.without(TEST), dataset.select(TEST)

    fit = identify(train, Polynomial(4))
    profile = [(0.0, 0.0), (2.9, 0.35)]
    tube = design(OutputTube(fit.model, train, profile=profile, safety_factor=1.5))

    inside = 0
    for trial in test:
        monitor = tube.monitor()
        samples = zip(trial.t, trial.y[:, 0], trial.u[:, 0], strict=False)
        readings = [monitor.update(t, y, u) for t, y, u in samples]
        inside += all(r.status in (Status.INSIDE, Status.UNKNOWN) for r in readings)

    error = simulation_percent(fit.model, test)
    return {"error": error, "inside": inside}, {"error": 8.5, "inside": 8}


if __name__ == "__main__":
    computed, known = run()
    for key, value in computed.items():
        print(f"{key:10s}{value:8.2f}   known {known[key]:g}")
