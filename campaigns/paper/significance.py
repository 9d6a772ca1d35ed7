"""Whether two small groups of runs differ: an exact permutation test, which assumes nothing about their distribution."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

LEVEL = 0.05
_ROUNDING = 1e-12


def permutation_p(a: Sequence[float], b: Sequence[float]) -> float:
    """Two-sided p-value of the difference of means: the share of all ways to divide the values that differ as much.

    With five runs each there are 252 ways, so p cannot be smaller than 2/252 = 0.008.
    """
    values, n = [*a, *b], len(a)
    if not a or not b:
        return 1.0
    total = sum(values)

    def difference(part: float) -> float:
        return abs(part / n - (total - part) / len(b))

    found = difference(sum(a)) - _ROUNDING * max(1.0, abs(total))
    splits = list(combinations(values, n))
    return sum(difference(sum(part)) >= found for part in splits) / len(splits)
