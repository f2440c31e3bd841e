"""A function of parameters as a task: the cheapest beams that hold a load, by their width and height.

es-service run my_config.yaml --set task.environment=function:beam:beam
"""

from __future__ import annotations

LENGTH, LOAD, DENSITY, STRENGTH, STIFFNESS = 3.0, 2e4, 7.8e3, 2.5e8, 2.0e11


def beam(parameters):
    """a hollow beam that carries a load at its end is to be light; it must neither break nor bend much"""
    width, height, wall = parameters
    inner_width, inner_height = max(0.0, width - 2.0 * wall), max(0.0, height - 2.0 * wall)
    area = width * height - inner_width * inner_height
    moment = (width * height**3 - inner_width * inner_height**3) / 12.0
    stress = LOAD * LENGTH * height / (2.0 * moment)
    bend = LOAD * LENGTH**3 / (3.0 * STIFFNESS * moment)
    too_much = max(0.0, stress / STRENGTH - 1.0) + max(0.0, bend / (LENGTH / 200.0) - 1.0)
    return -DENSITY * area * LENGTH - 1000.0 * too_much, (width, height)


beam.parameters = {"width": (0.05, 0.4), "height": (0.05, 0.4), "wall": (0.002, 0.05)}
beam.descriptor_names, beam.descriptor_bounds = ("w", "h"), ((0.05, 0.4), (0.05, 0.4))
beam.deterministic = True
beam.least_fitness = -5000.0
