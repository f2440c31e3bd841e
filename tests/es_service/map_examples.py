"""Maps of a plane."""

from es_service.api import load_config
from es_service.search.maps.geometry import Grid

SQUARE, OBLONG = ((-1.0, 1.0), (-1.0, 1.0)), ((0.0, 30.0), (-8.0, 8.0))


def map_config(task="point_maze", **settings):
    return load_config(
        {"task": {"environment": task}, "search": {"algorithm": "es"}, "map": settings, "budget": {"generations": 1}}
    ).map


PLANE = Grid(((0.0, 6.0), (0.0, 2.0)), (3, 4))
"""Cells of 2 by 0.5."""
