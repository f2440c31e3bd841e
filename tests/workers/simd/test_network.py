"""The policy's code by itself: what it computes for networks of all shapes, and what it leaves out for the dead."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from es_service.protocol.messages import PolicySpec
from es_service.protocol.noise import NORMAL_STD, Domain, normals, stream_keys
from tests.helpers import random_parameters
from tests.workers.simd.rollouts import every_target
from workers.simd.backend.function_builder import FunctionBuilder, module
from workers.simd.backend.native import aligned, load_compiled
from workers.simd.backend.target import Target
from workers.simd.episodes import hidden
from workers.simd.episodes.hidden import Network, keep_function, plan
from workers.simd.episodes.network import policy_function
from workers.simd.episodes.noise_kernels import fill_function

SIGMA = 0.1
UNTOUCHED = 7.0


def run(
    network: Network, target: Target, folder: Path, centre_D: np.ndarray, x: np.ndarray, alive: np.ndarray, keys: Any
) -> tuple[np.ndarray, np.ndarray]:
    """(actions [lane, output], hidden room after them) of a block of members; of the centre for keys None."""
    noisy = keys is not None
    arguments = ["x", "alive", "centre", "keys", "places", "noise", "hidden", "action"]
    builder = FunctionBuilder(
        "inside", [*(f"ptr noalias %{name}" for name in arguments), "float %unit"], network.target
    )
    fill = fill_function(network.vectors, len(network.places) - network.vectors, network.target)
    keep = [keep_function(network)] * (noisy and network.keeps_weights)
    if noisy:
        builder.do("call void @fill(ptr %keys, ptr %places, ptr %noise)")
    if keep:
        builder.do("call void @keep(ptr %centre, ptr %noise, float %unit)")
    given = "ptr %noise, float %unit, " if noisy else ""
    builder.do(f"call void @policy(ptr %x, ptr %alive, ptr %centre, {given}ptr %hidden, ptr %action)")
    functions = [fill, *keep, policy_function(network, "perturbed" if noisy else "shared"), builder]
    native = load_compiled(
        f"policy {network.places.tolist()} {noisy} {bool(keep)}", lambda: module(functions), target, folder
    )
    lanes = aligned((network.inputs if not network.hidden else network.hidden[0].inputs, network.width))
    lanes.view(np.float32)[:] = x.T
    hidden = aligned((max(1, network.hidden_vectors), network.width)).view(np.float32)
    hidden[:] = UNTOUCHED
    action = aligned((network.outputs, network.width))
    given_keys = keys if noisy else np.zeros((1, 4), np.uint32)
    noise = aligned((network.block_bytes // 4,)).view(np.int8)
    arrays = (lanes, alive, network.pack(centre_D), given_keys, network.places, noise, hidden, action)
    native.function(*[ctypes.c_void_p] * len(arrays), ctypes.c_float)(*arrays, SIGMA / NORMAL_STD)
    return action.view(np.float32).T.copy(), hidden.reshape(-1)


def actions_of(shape: PolicySpec, parameters_D: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The reference implementation, in float64."""
    values, start = x.astype(float), 0
    for inputs, outputs in shape.layers:
        weights = parameters_D[start : start + inputs * outputs].reshape(inputs, outputs)
        biases = parameters_D[start + inputs * outputs :][:outputs]
        values, start = np.tanh(values @ weights + biases), start + (inputs + 1) * outputs
    return values


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize("seen", [1, 2])
@pytest.mark.parametrize(
    "widths", [(3, 1), (2, 16, 2), (5, 64, 17), (4, 33, 48, 5), (29, 20, 8), (1, 1, 1), (7, 144, 3), (6, 40)]
)
def test_actions_are_those_of_members_with_their_own_weights(
    widths: tuple[int, ...], seen: int, target: Target, tmp_path: Path
):
    """Of every input, or of every second one, the others being zero."""
    shape = PolicySpec(widths)
    centre_D = random_parameters(4, shape.parameters, 0.5)
    inputs_O = np.arange(0, widths[0], seen)
    x = np.zeros((target.width, widths[0]), np.float32)
    x[:, inputs_O] = np.random.default_rng(0).normal(size=(target.width, len(inputs_O)))
    keys = stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(target.width // 2))
    network = plan(shape, inputs_O, target)
    alive = np.ones(target.width, np.int32)
    found, _ = run(network, target, tmp_path, centre_D, x[:, inputs_O], alive, keys)
    for member in range(target.width):
        noise_D = normals(keys[member // 2], shape.parameters)
        weights_D = centre_D + (1 - 2 * (member % 2)) * SIGMA * noise_D.astype(float)
        np.testing.assert_allclose(found[member], actions_of(shape, weights_D, x[member]), atol=3e-6)
    found, _ = run(network, target, tmp_path, centre_D, x[:, inputs_O], alive, None)
    np.testing.assert_allclose(found, actions_of(shape, centre_D.astype(float), x), atol=3e-6)


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_weights_made_once_per_episode_give_the_bits_of_those_made_in_each_step(
    target: Target, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shape = PolicySpec((5, 64, 17, 3))
    network = plan(shape, np.arange(5), target)
    centre_D, x = random_parameters(4, shape.parameters, 0.5), random_parameters(5, 5 * target.width, 1.0)
    keys = stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(target.width // 2))
    given = network, target, tmp_path, centre_D, x.reshape(-1, 5), np.ones(target.width, np.int32), keys
    assert network.keeps_weights
    kept, _ = run(*given)
    monkeypatch.setattr(hidden, "KEPT_BYTES", 0)
    assert not network.keeps_weights
    made, _ = run(*given)
    np.testing.assert_array_equal(kept, made)


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_the_dead_cost_nothing(noisy: bool, target: Target, tmp_path: Path):
    """Hidden layers of a group of neighbours all dead are not computed, and the others' actions are what they were."""
    shape = PolicySpec((3, 64, 64, 2))
    network, group = plan(shape, np.arange(3), target), min(8, target.width, target.sums_at_once)
    centre_D, x = random_parameters(4, shape.parameters, 0.5), np.ones((target.width, 3), np.float32)
    keys = stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(target.width // 2)) if noisy else None
    alive = np.ones(target.width, np.int32)
    everyone, _ = run(network, target, tmp_path, centre_D, x, alive, keys)
    alive[-group:] = 0
    for last_one in (0, 1):  # who keeps its neighbours company
        alive[-1] = last_one
        found, room = run(network, target, tmp_path, centre_D, x, alive, keys)
        np.testing.assert_array_equal(found[alive == 1], everyone[alive == 1])
        # That of the first is used again, for what the last one sees.
        second_layer = room[room.size // 2 :].reshape(target.width, -1)
        assert (second_layer[:-group] != UNTOUCHED).any(axis=1).all()
        assert (second_layer[-group:] != UNTOUCHED).any(axis=1).tolist() == [bool(last_one)] * group


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize("widths", [(2, 1), (2, 3, 1)])
def test_a_sum_starts_with_its_bias(target, widths, tmp_path):
    shape, wide = PolicySpec(widths), widths[1]
    centre_D = np.zeros(shape.parameters, np.float32)
    centre_D[: 3 * wide] = np.repeat(np.float32([1e8, -1e8, 1.0]), wide)  # weights of two inputs, then biases
    centre_D[3 * wide :] = 1.0 if len(widths) == 3 else 0.0
    if len(widths) == 3:
        centre_D[-1] = 0.0
    network = plan(shape, np.arange(2), target)
    x, alive = np.ones((target.width, 2), np.float32), np.ones(target.width, np.int32)
    found, _ = run(network, target, tmp_path, centre_D, x, alive, None)
    np.testing.assert_array_equal(found, 0.0)  # with the bias last, 0 + 1
