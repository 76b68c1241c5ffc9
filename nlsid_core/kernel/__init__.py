"""The kernel: decides whether a proof file proves its claim, and says what is then proved.

It is all that has to be trusted, and it can be read in one sitting. It imports the standard library
and nothing else, computes with whole numbers and fractions only, finds nothing (every witness is in
the file), and knows no other part of nlsid. `python -I <this folder> FILE.proof.json` runs it on a
bare Python. docs/certificate.md is its specification.

Read in this order: `files` (untrusted input), `exact` (definite matrices), `polynomials` and
`positivity` (positive polynomials), then the claims, each a module with one `decide`.
"""

from .checking import KINDS, LEFT, REASONS, check, decide
from .files import Rejected
from .text import Verdict

__all__ = ["KINDS", "LEFT", "REASONS", "Rejected", "Verdict", "check", "decide"]
