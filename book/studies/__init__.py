"""The studies of the book as functions of a random key: one call, one draw.

``python -m studies NAME`` repeats one of them for many seeds and writes the file of
results that the book reads. NAME is "quadratic" and "distinct" (case study 1), "settling" and
"ties" (case study 2), "measures" (what accuracy does not tell), "priors" and "calibration" (what a
prior is worth), "onesided" (a person whom no quadratic represents), "references" (many set
points), "signals" (what σ may see), "lane" (a car and its passenger), "stability",
"answers" (ties, strengths and rankings beside pairs), "people" (several, and such as change),
"asking" and "fewer" (strategies that choose the next question), "stopping", "limits" or "settled"
(when to stop asking, and when choosing fails).
"""

from studies.measures import baselines, measures_case
from studies.quadratic import (
    COLUMNS,
    PAPER_TABLE_I,
    QUADRATIC_HORIZON,
    QUADRATIC_Q,
    QUADRATIC_R,
    RADIUS,
    ROWS,
    SIZES,
    VARIANTS,
    QuadraticDraw,
    distinct_case,
    error_rates,
    quadratic_case,
    quadratic_data,
    quadratic_variants,
)
from studies.settling import (
    PAPER_TABLE_II,
    SETTLING_COLUMNS,
    SETTLING_HORIZON,
    SETTLING_ROWS,
    SETTLING_SIZES,
    SETTLING_VARIANTS,
    SettlingDraw,
    diagonal_weights,
    settling_case,
    settling_data,
    ties_case,
)
from studies.spread import quantiles, read_spread, write_spread

__all__ = [
    "COLUMNS",
    "PAPER_TABLE_I",
    "PAPER_TABLE_II",
    "QUADRATIC_HORIZON",
    "QUADRATIC_Q",
    "QUADRATIC_R",
    "RADIUS",
    "ROWS",
    "SETTLING_COLUMNS",
    "SETTLING_HORIZON",
    "SETTLING_ROWS",
    "SETTLING_SIZES",
    "SETTLING_VARIANTS",
    "SIZES",
    "VARIANTS",
    "QuadraticDraw",
    "SettlingDraw",
    "baselines",
    "diagonal_weights",
    "distinct_case",
    "error_rates",
    "measures_case",
    "quadratic_case",
    "quadratic_data",
    "quadratic_variants",
    "quantiles",
    "read_spread",
    "settling_case",
    "settling_data",
    "ties_case",
    "write_spread",
]
