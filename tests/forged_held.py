"""Files of a held funnel with one thing made better than it is, and why a checker refuses them."""

from tests.edits import Edit, put, scaled, without
from tests.funnel_files import POLICY, PROOF

RATES = f"{PROOF} proof rates"
HELD_FORGERIES: dict[str, tuple[Edit, str]] = {
    "a longer hold": (scaled(f"{PROOF} claim hold", 1.5), "not_positive"),
    "a state that is measured worse": (scaled(f"{PROOF} claim error", 5.0), "not_positive"),
    "an input that turns more slowly": (scaled(f"{RATES} 3 0", 0.5), "not_positive"),
    "a rate piece less": (without(f"{PROOF} proof rate_pieces 7"), "not_covered"),
    "rates of one sign": (put(f"{PROOF} proof rate_pieces * sign", 1), "not_covered"),
    "a rate of 0": (put(f"{RATES} 0 0", 0.0), "not_below"),
    "gains that jump at a knot": (scaled(f"{POLICY} K 4 0 0 0", 1.001), "not_valid"),
    "rates and no hold": (without(f"{PROOF} claim hold"), "malformed"),
}
