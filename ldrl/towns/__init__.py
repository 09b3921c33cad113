"""Maps: street layouts and OpenDRIVE files, as highway-env road networks, compiled into tensors; routes on them."""

from ldrl.towns.generator import random_layout
from ldrl.towns.layout import LAYOUTS, Layout, load_layout
from ldrl.towns.matching import match_route
from ldrl.towns.routes import Route, UnrealisableError, plan_route, plan_routes
from ldrl.towns.town import ROUTE_LANES, Town

__all__ = [
    "LAYOUTS",
    "ROUTE_LANES",
    "Layout",
    "Route",
    "Town",
    "UnrealisableError",
    "load_layout",
    "match_route",
    "plan_route",
    "plan_routes",
    "random_layout",
]
