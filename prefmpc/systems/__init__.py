"""Plants: linear and nonlinear ones, the book's own, and sets that states and inputs keep to."""

from prefmpc.systems.linear import LinearSystem, oscillating_masses
from prefmpc.systems.nonlinear import NonlinearSystem
from prefmpc.systems.plants import cart_pendulum, kinematic_bicycle
from prefmpc.systems.sets import Ellipsoid, Polyhedron, SecondOrderCone

__all__ = [
    "Ellipsoid",
    "LinearSystem",
    "NonlinearSystem",
    "Polyhedron",
    "SecondOrderCone",
    "cart_pendulum",
    "kinematic_bicycle",
    "oscillating_masses",
]
