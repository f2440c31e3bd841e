"""Columns about all evaluated centres have the bits that each centre's episodes alone would give."""

import math

import numpy as np
import pytest

from es_service.loop.contents import no_statistics, policy_work
from es_service.loop.evaluated import told_of_asks
from es_service.loop.history import episodes_table, evaluation_columns
from es_service.protocol.messages import EpisodesResult, PolicySpec, TaskSpec
from es_service.search.algorithms.base import PolicyAsk

TASK = TaskSpec("maze", 2, 2, 200, ("x", "y"), ((-1.0, 1.0),) * 2, False, True)
LAYOUTS = {
    "episodes side by side": lambda values: np.ascontiguousarray(values),
    "centres side by side": lambda values: np.ascontiguousarray(values.swapaxes(0, 1)).swapaxes(0, 1),
    "reversed": lambda values: np.ascontiguousarray(values[::-1])[::-1],
}


def results(centres, episodes, layout):
    random = np.random.default_rng(centres * 100 + episodes)

    def some(*axes):
        return layout((random.normal(size=(centres, episodes, *axes)) * 100.0).astype(np.float32))

    fitness = some()
    fitness[0, -1] = np.inf
    fitness[-1, 0] = np.nan
    steps = layout(random.integers(1, 200, (centres, episodes), np.int32))
    return EpisodesResult(fitness, some(), some(2), steps, some(2), None)


def alone(result, row):
    """What is recorded of a centre, from its episodes [E]."""
    fitness, returns = result.fitness[row].copy(), result.returns[row].copy()
    x, y = result.descriptor[row].copy().mean(axis=0, dtype=np.float64)
    end, least = result.goal_distance[row].copy().T
    return {
        "fitness_mean": fitness.mean(dtype=np.float64),
        "fitness_std": fitness.std(dtype=np.float64),
        "fitness_max": fitness.max(),
        "return_mean": returns.mean(dtype=np.float64),
        "x": x,
        "y": y,
        "goal_distance": end.mean(dtype=np.float64),
        "goal_distance_way": least.mean(dtype=np.float64),
        "goal_distance_min": least.min(),
    }


def bits(values):
    """Equal for equal numbers, and for any two NaN, whose signs NumPy does not fix."""
    return [None if math.isnan(value) else np.float64(value).tobytes() for value in values]


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("episodes", [1, 2, 7, 8, 9, 13, 16, 30, 129, 300])
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("centres", [1, 2, 23])
def test_columns_have_the_bits_of_each_centre_alone(centres, layout, episodes):
    result = results(centres, episodes, layout)
    table = episodes_table(result, TASK)
    work = policy_work(np.zeros((centres, 1), np.float32), no_statistics(centres, 2), episodes, seed=0, generation=3)
    asks = [PolicyAsk(work.parameters_N_D)]
    told, _ = told_of_asks(
        3, asks, [], [(work, result)], seed=0, centres=0, fitness_weight=1.0, spec=PolicySpec((2, 2))
    )
    for row in range(centres):
        expected = alone(result, row)
        assert table.keys() == expected.keys()
        assert bits(table[name][row] for name in expected) == bits(expected.values())
        assert bits([told[row].fitness, *told[row].descriptor_B]) == bits(
            expected[name] for name in ("fitness_mean", "x", "y")
        )
        assert told[row].valid == (centres > 2 and 0 < row < centres - 1)
        columns = evaluation_columns(table, result, row, TASK)
        spread = result.descriptor[row].copy().std(axis=0, dtype=np.float64)
        assert bits([columns["centre_x_std"], columns["centre_y_std"]]) == bits(spread)
        assert bits([columns["centre_return_std"]]) == bits([result.returns[row].copy().std(dtype=np.float64)])
