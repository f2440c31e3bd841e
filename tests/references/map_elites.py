"""MAP-Elites once more, slowly and in float64: one policy, one parameter at a time."""

from tests.references.behaviour_map import Elite


class MapElites:
    def __init__(self, map_, iso_sigma, line_sigma):
        """map_: an empty GridMap."""
        self.map, self.iso_sigma, self.line_sigma = map_, iso_sigma, line_sigma

    def policy(self, first, second, noise):
        """(the cells of the parents that two numbers from [0, 1) stand for, their child).

        noise: a number for each parameter, and the last one for the line.
        """
        cells = list(self.map.elites)
        x, y = (cells[int(drawn * len(cells))] for drawn in (first, second))
        child = []
        for here, there, own in zip(self.map.elites[x].centre, self.map.elites[y].centre, noise, strict=False):
            along = self.line_sigma * noise[-1] * (there - here)
            child.append(here + self.iso_sigma * own + along)
        return (x, y), child

    def evaluated(self, generation, number, policy, fitness, descriptor):
        """The cell that a policy entered; None if it entered none."""
        return self.map.insert(Elite(fitness, descriptor, generation, float("nan"), policy, number))
