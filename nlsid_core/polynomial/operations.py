"""Which operations Python and NumPy may apply to a polynomial, and the names of those they may not.

NumPy calls methods by name on the entries of an object array (np.sin becomes .sin()), Python the
double-underscore ones. A refused operation says which it was.
"""

# ufunc: method if the polynomial is the first operand, and if it is the second
OPERATORS = {
    "add": ("__add__", "__radd__"),
    "subtract": ("__sub__", "__rsub__"),
    "multiply": ("__mul__", "__rmul__"),
    "divide": ("__truediv__", "__rtruediv__"),
    "power": ("__pow__", "__rpow__"),
    "negative": ("__neg__", "__neg__"),
    "positive": ("__pos__", "__pos__"),
}

_FUNCTIONS = """
    sin cos tan arcsin arccos arctan sinh cosh tanh arcsinh arccosh arctanh exp exp2 expm1
    log log2 log10 log1p sqrt cbrt floor ceil trunc rint hypot arctan2
"""

# method: what the message calls it
REFUSED = {name: name for name in _FUNCTIONS.split()} | {
    "__abs__": "abs",
    "__mod__": "remainder",
    "__rmod__": "remainder",
    "__floordiv__": "floor division",
    "__rfloordiv__": "floor division",
    "__rpow__": "exponentiation with an exponent",
    "__lt__": "comparison <",
    "__le__": "comparison <=",
    "__gt__": "comparison >",
    "__ge__": "comparison >=",
    "__bool__": "the truth value",
}
