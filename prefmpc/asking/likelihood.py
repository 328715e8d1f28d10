"""The likelihood of answers of somebody who now and then tosses a coin."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import expit


def lapsing(z: Any, labels: Any, rate: Any) -> tuple[Any, Any, Any, Any]:
    """Return the loss, its two derivatives by z, and those by the rate: ∂ε, ∂ε∂z and ∂ε²."""
    s = expit(z)
    p = rate / 2 + (1 - rate) * s
    q = rate / 2 + (1 - rate) * (1 - s)
    loss = -labels * np.log(p) - (1 - labels) * np.log(q)
    by_p = (1 - labels) / q - labels / p
    by_pp = labels / p**2 + (1 - labels) / q**2
    ds = s * (1 - s)
    p_z, p_zz, p_e, p_ez = (1 - rate) * ds, (1 - rate) * ds * (1 - 2 * s), 0.5 - s, -ds
    curvature = by_pp * p_z**2 + by_p * p_zz
    by_rate = by_p * p_e, by_pp * p_e * p_z + by_p * p_ez, by_pp * p_e**2
    return loss, by_p * p_z, curvature, by_rate
