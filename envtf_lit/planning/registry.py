"""The planners by name."""

from typing import Any

from envtf_lit.planning.gradient import GradientPlanner
from envtf_lit.planning.planner import Planner
from envtf_lit.planning.shooting import CEM, ICEM, MPPI, RandomShooting

PLANNERS: dict[str, type[Planner[Any]]] = {
    "random": RandomShooting,
    "cem": CEM,
    "icem": ICEM,
    "mppi": MPPI,
    "gradient": GradientPlanner,
}
