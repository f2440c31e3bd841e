"""MEMES once more, slowly and in float64, on top of the other reference implementations: one emitter at a time."""

import math

from tests.references.behaviour_map import Elite
from tests.references.es import ES, averaged_centred_ranks
from tests.references.novelty_search import novelty


class Memes:
    def __init__(self, centres, map_, learning_rate, l2, *, mode, patience, neighbours, newest):
        """map_: an empty GridMap or SlotMap; mode: explore, exploit or explore_exploit; patience: generations until a
        reset."""
        self.learning_rate, self.l2, self.patience = learning_rate, l2, patience
        self.neighbours, self.newest = neighbours, newest
        self.map, self.archive = map_, []
        self.emitters = [ES(centre, learning_rate, l2) for centre in centres]
        self.explores = [mode == "explore" or (mode == "explore_exploit" and i % 2 == 0) for i in range(len(centres))]
        self.useless = [0] * len(centres)

    def begin(self, drawn):
        """Begin a generation: the cell from which each emitter begins again, or None. drawn: a number for each."""
        cells, begun = list(self.map.elites), []
        for i, number in enumerate(drawn):
            begun.append(None)
            if cells and self.useless[i] >= self.patience:
                begun[i] = cells[int(number * len(cells))]
                self.emitters[i] = ES(self.map.elites[begun[i]].centre, self.learning_rate, self.l2)
                self.useless[i] = 0
        return begun

    def novelty(self, place):
        """Against the newest entries alone."""
        return novelty(self.archive[-self.newest :], place, self.neighbours)

    def climb(self, emitter, noise_P_D, fitness_P_S, descriptor_P_S_B):
        objective = fitness_P_S.ravel()
        if self.explores[emitter]:
            objective = [self.novelty(place) for place in descriptor_P_S_B.reshape(len(objective), -1)]
        utility = averaged_centred_ranks(objective).reshape(fitness_P_S.shape)
        self.emitters[emitter].climb(noise_P_D, utility)

    def end(self, generation, evaluated):
        """Learn from (fitness, descriptor) of every emitter: the cell of which each is the elite now, or None."""
        offered = []
        for i, (fitness, descriptor) in enumerate(evaluated):
            offered.append(Elite(fitness, descriptor, generation, math.nan, self.emitters[i].centre, i))
            self.archive.append(descriptor)
        mine = self.map.offer(offered)
        for i, cell in enumerate(mine):
            self.useless[i] = self.useless[i] + 1 if cell is None else 0
        return mine
