"""ME-ES once more, slowly and in float64, on top of the other references: one elite, one number at a time."""

import math

from tests.references.behaviour_map import Elite
from tests.references.es import ES, averaged_centred_ranks
from tests.references.novelty_search import novelty


def best(cells, values, count):
    """The cells with the highest values, best first; of equal ones the first in the list."""
    left, found = list(cells), []
    while left and len(found) < count:
        winner = left[0]
        for cell in left:
            if values[cell] > values[winner]:
                winner = cell
        left.remove(winner)
        found.append(winner)
    return found


def explore_shares(sampling, novelty_of, drawn):
    """Cell -> share, of the cells that exploring may start from."""
    cells = list(novelty_of)
    top = best(cells, novelty_of, 5)
    if sum(novelty_of.values()) == 0.0 or (sampling == "score" and drawn < 0.1):
        return dict.fromkeys(cells, 1.0)
    return {cell: 1.0 if sampling == "top" else novelty_of[cell] for cell in top}


def exploit_shares(sampling, elites, drawn):
    """Cell -> share, of the cells that exploiting may start from; `elites` in the order of discovery."""
    cells = list(elites)
    if sampling == "top":
        fitness = {cell: elite.fitness for cell, elite in elites.items()}
        generation = {cell: elite.generation for cell, elite in elites.items()}
        newest = best(cells, generation, 5)
        among = cells if drawn < 0.5 else [cell for cell in cells if cell in newest]
        return dict.fromkeys(best(among, fitness, 2), 1.0)
    score = {cell: -math.inf if math.isnan(elite.score) else elite.score for cell, elite in elites.items()}
    if drawn < 0.5 or len(cells) < 5:
        return {best(cells, score, 1)[0]: 1.0}
    lowest = min([s for s in score.values() if s > -math.inf], default=0.0)
    newest = cells[len(cells) - min(5, len(cells) // 2) :]
    return {cell: max(score[cell], lowest) - lowest + 1.0 for cell in best(newest, score, 2)}


def roulette(share_of, cells, uniform):
    """The cell that a number drawn from [0, 1) stands for, all cells lying side by side in their order."""
    total = sum(share_of.get(cell, 0.0) for cell in cells)
    below = 0.0
    for cell in cells:
        below += share_of.get(cell, 0.0)
        if uniform * total < below:
            return cell
    raise AssertionError


class MapElitesES:
    def __init__(
        self, centre, map_, learning_rate, l2, *, mode, first_block, length, sampling, neighbours, squared, emitter=0
    ):
        """map_: an empty GridMap; length: generations in a block; mode: explore, exploit or explore_exploit."""
        self.map, self.archive, self.evaluated_in = map_, [], []
        self.learning_rate, self.l2 = learning_rate, l2
        self.mode, self.length, self.sampling = mode, length, sampling
        self.first_block = other(first_block) if emitter % 2 else first_block
        self.neighbours, self.squared = neighbours, squared
        self.es, self.climbs, self.left, self.elite = ES(centre, learning_rate, l2), None, 0, None
        self.emitter = emitter

    def start(self, first, second):
        """Begin a generation, and with it a block where one is due: the cell it starts from, else None."""
        start_cell = None
        if self.left == 0:
            self.climbs, self.left = self.next_objective(), self.length
            start_cell = self.drawn_cell(first, second)
            self.elite = self.map.elites[start_cell]
            self.es = ES(self.elite.centre, self.learning_rate, self.l2)
        self.left -= 1
        return start_cell

    def next_objective(self):
        if self.mode != "explore_exploit":
            return self.mode
        return self.first_block if self.climbs is None else other(self.climbs)

    def drawn_cell(self, first, second):
        elites = self.map.elites
        if self.climbs == "exploit":
            shares = exploit_shares(self.sampling, elites, first)
        else:
            shares = explore_shares(self.sampling, {cell: self.elite_novelty(elites[cell]) for cell in elites}, first)
        return roulette(shares, list(elites), second)

    def elite_novelty(self, elite):
        """In today's archive, without the entry that the elite itself made."""
        own = self.evaluated_in.index((elite.generation, elite.emitter))
        return novelty(self.archive, elite.descriptor, self.neighbours, self.squared, without=own)

    def climb(self, noise_P_D, fitness_P_S, descriptor_P_S_B):
        objective = fitness_P_S.ravel()
        if self.climbs == "explore":
            places = descriptor_P_S_B.reshape(len(objective), -1)
            objective = [novelty(self.archive, place, self.neighbours, self.squared) for place in places]
        self.es.climb(noise_P_D, averaged_centred_ranks(objective).reshape(fitness_P_S.shape))

    def evaluated(self, generation, fitness, descriptor, population_max=math.nan):
        """Learn from a centre's evaluation: the cell it entered, or None."""
        if self.elite is not None and generation > 0:
            self.elite.score = population_max  # which no one will see if another elite has taken its cell
        self.elite = Elite(fitness, descriptor, generation, population_max, self.es.centre, self.emitter)
        cell = self.map.insert(self.elite)
        if cell is None:
            self.elite = None
        self.archive.append(descriptor)
        self.evaluated_in.append((generation, self.emitter))
        return cell


def other(climbs):
    return "exploit" if climbs == "explore" else "explore"


def side_by_side(centres, map_, *settings, **more):
    """Emitters that share a map and an archive: one reference implementation for each centre."""
    emitters = [MapElitesES(centre, map_, *settings, emitter=i, **more) for i, centre in enumerate(centres)]
    for emitter in emitters:
        emitter.archive, emitter.evaluated_in = emitters[0].archive, emitters[0].evaluated_in
    return emitters
