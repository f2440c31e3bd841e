"""A dominated map once more, for reading: one pair of elites at a time, a dict from slot to elite."""

import math


def distance(first, second):
    square = 0.0
    for x, y in zip(first, second, strict=True):
        square += (float(x) - float(y)) * (float(x) - float(y))
    return math.sqrt(square)


def dominated_novelty(elites, neighbours):
    """Of each elite, the mean distance to its nearest fitter ones. `elites` begins with the oldest, which of equally
    fit ones counts as the fittest."""
    found = []
    for age, elite in enumerate(elites):
        fitter = [
            other
            for other_age, other in enumerate(elites)
            if other.fitness > elite.fitness or (other.fitness == elite.fitness and other_age < age)
        ]
        nearest = sorted(distance(elite.descriptor, other.descriptor) for other in fitter)[:neighbours]
        total = 0.0
        for one in nearest:
            total += one
        found.append(total / len(nearest) if nearest else math.inf)
    return found


class SlotMap:
    """`elites` is in the order in which elites entered."""

    def __init__(self, slots, neighbours):
        self.slots, self.neighbours, self.elites = slots, neighbours, {}

    def offer(self, elites):
        """Let elites compete with those of the map: the slot that each has then, None for one that did not enter."""
        every = [*self.elites.values(), *elites]
        novelty = dominated_novelty(every, self.neighbours)
        ranking = sorted(range(len(every)), key=lambda age: (-novelty[age], -every[age].fitness, age))
        stay = [every[age] for age in sorted(ranking[: self.slots])]
        slots = {slot: elite for slot, elite in self.elites.items() if any(elite is one for one in stay)}
        free = [slot for slot in range(self.slots) if slot not in slots]
        for elite in stay:
            if not any(elite is one for one in slots.values()):
                slots[free.pop(0)] = elite
        self.elites = slots
        return [next((slot for slot, elite in slots.items() if elite is one), None) for one in elites]

    def insert(self, elite):
        """The slot that an elite entered alone, or None."""
        return self.offer([elite])[0]
