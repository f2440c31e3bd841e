"""Random functions of every primitive that simd compiles, with arguments."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from jax import lax
from jax.extend.random import threefry_prng_impl

from tests.workers.simd import index_cases
from tests.workers.simd.draws import Case, Draw, booleans, floats, integers, shape, special


def unary(function: Callable, low: float = -3.0, high: float = 3.0) -> Callable[[Draw], Case]:
    return lambda draw: (function, [floats(draw, shape(draw), low, high)])


def binary(function: Callable, make: Callable = floats) -> Callable[[Draw], Case]:
    def case(draw: Draw) -> Case:
        of = shape(draw)
        return function, [make(draw, of), make(draw, of)]

    return case


def reduction(function: Callable, make: Callable = floats) -> Callable[[Draw], Case]:
    def case(draw: Draw) -> Case:
        of = shape(draw, least=1)
        axes = tuple(draw(st.sets(st.integers(0, len(of) - 1), min_size=1)))
        return lambda x: function(x, axes), [make(draw, of)]

    return case


def along(function: Callable, make: Callable = floats) -> Callable[[Draw], Case]:
    def case(draw: Draw) -> Case:
        of = shape(draw, least=1)
        axis, reverse = draw(st.integers(0, len(of) - 1)), draw(st.booleans())
        return lambda x: function(x, axis, reverse), [make(draw, of)]

    return case


def slices(draw: Draw) -> Case:
    of = shape(draw, least=1)
    at = tuple(slice(draw(st.integers(0, n - 1)), n, draw(st.integers(1, 2))) for n in of)
    return lambda x: x[at], [floats(draw, of)]


def pads(draw: Draw) -> Case:
    of = shape(draw, least=1, most=2)
    how = [(draw(st.integers(-1, 2)), draw(st.integers(0, 2)), draw(st.integers(0, 2))) for _ in of]
    return lambda x, v: lax.pad(x, v, how), [floats(draw, of), floats(draw, ())]


def dots(draw: Draw) -> Case:
    b, m, k, n = (draw(st.integers(1, 4)) for _ in range(4))
    which = draw(st.sampled_from(["matrix", "batch", "integers"]))
    if which == "matrix":
        return jnp.dot, [floats(draw, (m, k)), floats(draw, (k, n))]
    if which == "batch":
        return lambda x, y: jnp.einsum("bmk,bkn->bmn", x, y), [floats(draw, (b, m, k)), floats(draw, (b, k, n))]
    constant = np.arange(k * n, dtype=np.int32).reshape(k, n)
    return lambda x: lax.dot_general(
        x, constant, (((1,), (0,)), ((), ())), preferred_element_type=jnp.float32
    ), [floats(draw, (m, k))]  # fmt: skip


def choices(draw: Draw) -> Case:
    of = shape(draw)
    make = draw(st.sampled_from([floats, integers, booleans]))
    return jnp.where, [booleans(draw, of), make(draw, of), make(draw, of)]


def arg_extremes(draw: Draw) -> Case:
    of, dtype = shape(draw, least=1), draw(st.sampled_from(["bool", "int32", "uint32"]))
    axis = draw(st.integers(0, len(of) - 1))
    x = booleans(draw, of) if dtype == "bool" else integers(draw, of, dtype) % 5
    return lambda x: (jnp.argmin(x, axis), jnp.argmax(x, axis)), [x]


def selections(draw: Draw) -> Case:
    of, count = shape(draw), draw(st.integers(1, 4))
    make = draw(st.sampled_from([floats, integers]))
    conditions = [booleans(draw, of) for _ in range(count)]
    return lambda conditions, x: jnp.select(list(conditions), [x * (k + 1) for k in range(count)], 3), [
        np.stack(conditions, 1),
        make(draw, of),
    ]


def branches(draw: Draw) -> Case:
    functions = [lambda x: x + 1.0, lambda x: x * 2.0, lambda x: -x]
    if draw(st.booleans()):
        return lambda i, x: lax.switch(jnp.clip(i, -1, 4), functions, x), [
            integers(draw, ()) % 5,
            floats(draw, (3,)),
        ]
    return lambda p, x: lax.cond(p, *functions[:2], x), [booleans(draw, ()), floats(draw, (3,))]


def scans(draw: Draw) -> Case:
    reverse = draw(st.booleans())

    def function(x):
        return lax.scan(lambda carry, row: (carry * 0.5 + row.sum(), carry + row), 0.0, x, reverse=reverse)

    return function, [floats(draw, (4, 2))]


def loops(draw: Draw) -> Case:
    trips = draw(st.integers(1, 5))
    return lambda x: lax.while_loop(lambda c: c[0] < trips, lambda c: (c[0] + 1, c[1] * 0.5 + 1.0), (0, x)), [
        floats(draw, (2,))
    ]


def loops_by_data(draw: Draw) -> Case:
    """Loops whose ends depend on data: also with a bound, inside of others, of branches and of lanes of their own."""
    most, bound = draw(st.floats(2.0, 9.0)), draw(st.integers(1, 30))

    def grown(x):
        return lax.while_loop(lambda y: jnp.abs(y).sum() < most, lambda y: y * 1.25 + jnp.sign(y) * 0.01, x + 0.1)

    def bounded(x):
        end = lax.while_loop(
            lambda c: (c[0] < bound) & (c[1].sum() < most), lambda c: (c[0] + 1, c[1] + grown(c[1] * 0.3)), (0, x)
        )
        return *end, lax.cond(x[0] > 0, grown, lambda x: -x, x)

    def scanned(x):
        def trip(carry, _):
            y, going = carry
            after = lax.cond(going, lambda y: (y * 1.1 + 0.05, (y * 1.1).sum() < most), lambda y: (y, False), y)
            return after, None

        return lax.scan(trip, (x, x[0] > -1.0), None, length=bound)[0]

    which = draw(st.sampled_from([grown, bounded, scanned, jax.vmap(grown), jax.vmap(bounded)]))
    return which, [floats(draw, (2, 2) if which not in (grown, bounded, scanned) else (2,))]


def conversions(draw: Draw) -> Case:
    source = draw(st.sampled_from(["float32", "int32", "uint32", "bool"]))
    target = draw(st.sampled_from(["float32", "int32", "bool"]))
    of = shape(draw)
    make = {"float32": lambda: floats(draw, of, -300, 300), "bool": lambda: booleans(draw, of)}
    x = make.get(source, lambda: integers(draw, of, source))()
    return lambda x: x.astype(target), [x]


def compares(draw: Draw) -> Case:
    make = draw(st.sampled_from([special, integers, lambda d, s: integers(d, s, "uint32")]))
    return binary(lambda a, b: (a == b, a != b, a < b, a <= b, a > b, a >= b), make)(draw)


def extremes(draw: Draw) -> Case:
    make = draw(st.sampled_from([special, integers, booleans]))
    return binary(lambda a, b: (lax.max(a, b), lax.min(a, b)), make)(draw)


def constant_integers(draw: Draw) -> Case:
    a = np.array(draw(st.lists(st.integers(-20, 20), min_size=2, max_size=4)), np.int32)
    b = np.array([draw(st.integers(1, 5)) * draw(st.sampled_from([-1, 1])) for _ in a], np.int32)
    return lambda x: x + lax.div(jnp.array(a), jnp.array(b)) + lax.rem(jnp.array(a), jnp.array(b)), [
        integers(draw, a.shape)
    ]


def calls(draw: Draw) -> Case:
    @jax.custom_vjp
    def backward(x):
        return x * 2.0

    backward.defvjp(lambda x: (x * 2.0, None), lambda _, g: (g,))
    safe = jax.custom_jvp(lambda x: x + 1.0)
    safe.defjvp(lambda x, t: (x[0], t[0]))

    def function(x):
        chosen = lax.platform_dependent(x, cpu=lambda x: x + 3.0, default=lambda x: x)
        return jax.jit(jax.checkpoint(backward))(safe(chosen)) + lax.stop_gradient(lax.optimization_barrier(x))

    return function, [floats(draw, (2,))]


def moves(draw: Draw) -> Case:
    of = shape(draw, least=1)
    order = draw(st.permutations(range(len(of))))

    def function(x):
        y = jnp.transpose(x, order)
        return (
            y.reshape(-1), jnp.flip(x, 0), jnp.concatenate([x, x], 0), jnp.stack([x, x], 0), jnp.tile(x, 2),
            x.ravel(order="F"), lax.reshape(x, (x.size,), order),
            jnp.unstack(x, axis=0)[-1], *jnp.split(jnp.tile(x, 3), [of[-1], 2 * of[-1] + 1], -1),
            jnp.squeeze(x[None], 0), jnp.broadcast_to(x[None], (2, *of)), jnp.copy(x), jax.device_put(x),
            x + lax.broadcasted_iota(jnp.float32, of, len(of) - 1), lax.expand_dims(x, (0,)),
        )  # fmt: skip

    return function, [floats(draw, of)]


def bits(draw: Draw) -> Case:
    def function(x, y, z):
        unsigned = lax.bitcast_convert_type(x, jnp.uint32)
        return (
            lax.bitcast_convert_type(unsigned ^ 1, jnp.float32), lax.bitcast_convert_type(y, jnp.uint32),
            y << 3, y >> 5, unsigned >> 7, jnp.bitwise_count(unsigned), y & 12, y | 3, y ^ y[::-1], ~y,
            z & z[::-1], z | z[::-1], z ^ z[::-1], ~z,
        )  # fmt: skip

    return function, [floats(draw, (3,)), integers(draw, (3,)), booleans(draw, (3,))]


def exactly(x: jax.Array) -> jax.Array:
    """Numbers as what a comparison tells apart: the bits of floats, of which those of a NaN do not count."""
    return jnp.where(jnp.isnan(x), 0, lax.bitcast_convert_type(x, jnp.int32)) if x.dtype == jnp.float32 else x


ORDERED = (special, integers, lambda draw, of: integers(draw, of, "uint32") % 5, booleans)


def sorts(draw: Draw) -> Case:
    of = (*shape(draw, most=1), draw(st.integers(1, 9)))
    of = of if draw(st.booleans()) else of[::-1]
    axis, keys = draw(st.integers(0, len(of) - 1)), draw(st.integers(1, 3))
    operands = [draw(st.sampled_from(ORDERED))(draw, of) for _ in range(draw(st.integers(keys, 3)))]
    return lambda *x: [exactly(one) for one in lax.sort(x, axis, num_keys=keys)], operands


def sorts_of_constants(draw: Draw) -> Case:
    keys = draw(st.sampled_from(ORDERED))(draw, (2, 5))[0]
    descends = draw(st.booleans())
    return lambda x: [exactly(one) for one in lax.sort((keys, x), 1)] + [jnp.argsort(keys, 0, descending=descends)], [
        floats(draw, keys.shape)
    ]


def greatest(draw: Draw) -> Case:
    of = (*shape(draw, most=1), draw(st.integers(1, 9)))
    count = draw(st.integers(1, of[-1]))

    def function(x):
        found, at = lax.top_k(x, count)
        return exactly(found), at

    return function, [draw(st.sampled_from(ORDERED[:3]))(draw, of)]


def cholesky(draw: Draw) -> Case:
    """Positive definite matrices, since their diagonals dominate, some of whose elements are known to be 0."""
    batch, n = shape(draw, most=1), draw(st.integers(1, 6))
    known = np.random.default_rng(draw(st.integers(0, 99))).random((n, n)) < 0.7
    known = known & known.T | np.eye(n, dtype=bool)
    halves = draw(st.booleans())  # otherwise the lower triangle alone is read
    diagonals = np.eye(n, dtype=np.float32) * floats(draw, (*batch, n, 1), 1.0, 3.0)
    matrices = floats(draw, (*batch, n, n), -0.5, 0.5) / n + diagonals
    return lambda a: lax.linalg.cholesky(jnp.where(known, a, 0.0), symmetrize_input=halves), [matrices]


def solves_of_trees(draw: Draw) -> Case:
    """Systems of a robot, whose links are numbered from the trunk outwards: only a link and what carries it meet."""
    n, columns = draw(st.integers(1, 7)), draw(st.integers(1, 2))
    carriers = [draw(st.integers(0, link)) - 1 for link in range(n)]  # -1 carries what no link does
    meet = np.eye(n, dtype=bool)
    for link, carrier in enumerate(carriers):
        meet[link] |= meet[carrier] if carrier >= 0 else False
    meet |= meet.T
    diagonals = np.eye(n, dtype=np.float32) * floats(draw, (n, 1), 1.0, 3.0)

    def function(a, b):
        factor = jax.scipy.linalg.cho_factor(jnp.where(meet, a, 0.0))
        return jax.scipy.linalg.cho_solve(factor, b), jax.scipy.linalg.cho_solve(factor, 2.0 * b[::-1])

    return function, [floats(draw, (n, n), -0.5, 0.5) / n + diagonals, floats(draw, (n, columns))]


def triangular_solve(draw: Draw) -> Case:
    """What must not be read is NaN."""
    batch, n, columns = shape(draw, most=1), draw(st.integers(1, 5)), draw(st.integers(1, 3))
    left, lower, transposed, unit = (draw(st.booleans()) for _ in range(4))
    matrices = floats(draw, (*batch, n, n), -0.5, 0.5) + np.eye(n, dtype=np.float32) * 2.0
    read = np.tri(n, k=-unit, dtype=bool)
    matrices = np.where(read if lower else read.T, matrices, np.float32(np.nan))
    right = floats(draw, (*batch, *((n, columns) if left else (columns, n))))
    return lambda a, b: lax.linalg.triangular_solve(
        a, b, left_side=left, lower=lower, transpose_a=transposed, unit_diagonal=unit
    ), [matrices, right]  # fmt: skip


NARROW = ("int8", "uint8", "int16", "uint16")


def narrow(draw: Draw) -> Case:
    """Integers of 8 and 16 bits, which wrap around in their own range."""
    dtype, of = draw(st.sampled_from(NARROW)), shape(draw, least=1, most=2)
    axis = draw(st.integers(0, len(of) - 1))

    def arithmetic(a, b):
        return (
            a + b, a - b, a * b, -a, abs(a), lax.square(a), lax.integer_pow(a, 3), ~a, a ^ b, lax.div(a, b),
            lax.rem(a, b),
        )  # fmt: skip

    def along_axes(a, b):
        return (
            a.sum(axis), a.prod(axis), jnp.cumsum(a, axis), lax.cummax(a, axis), jnp.argmax(a, axis), jnp.sort(a, axis),
            jnp.zeros(5, a.dtype).at[(b.reshape(-1) % 5).astype(jnp.int32)].add(a.reshape(-1)),
        )  # fmt: skip

    def others(a, b):
        by = b & 7
        return (
            a < b, a <= b, a == b, lax.max(a, b), jnp.sign(a), a.astype(jnp.float32),
            jnp.bitwise_count(a) + jnp.uint8(255), lax.clz(a), a << by, a >> by, lax.shift_right_logical(a, by),
            *(a.astype(one) for one in (*NARROW, "int32", bool)),
            lax.bitcast_convert_type(a, f"int{8 * a.dtype.itemsize}"),
        )  # fmt: skip

    return draw(st.sampled_from([arithmetic, along_axes, others])), [integers(draw, of).astype(dtype) for _ in range(2)]


def shifts(draw: Draw) -> Case:
    dtype = draw(st.sampled_from(["int32", "uint32"]))
    by = integers(draw, (3,), dtype)
    return lambda a, b: (
        lax.shift_left(a, b), lax.shift_right_logical(a, b), lax.shift_right_arithmetic(a, b), lax.clz(a), a >> 32,
        a << 32,
    ), [integers(draw, (3,), dtype), np.where(by % 3 == 0, by, by % 40)]  # fmt: skip


def orders(draw: Draw) -> Case:
    make = draw(st.sampled_from(ORDERED[:3]))
    return lambda a, b: (
        jnp.searchsorted(jnp.sort(a), b), lax.le_to_p.bind(a, b), lax.lt_to_p.bind(a, b)
    ), [make(draw, (5,)), make(draw, (5,))]  # fmt: skip


def keys_of_jax(draw: Draw) -> Case:
    """Typed keys, which are moved, chosen and carried by loops as other values are, and raw ones."""
    seed = draw(st.integers(0, 9))

    def made(words, number, which):
        keys = jax.random.split(jax.random.wrap_key_data(words), (2, 2))
        chosen = jnp.where(which, keys[1, 1], jax.random.fold_in(keys[0, 0], number))
        batch = jax.vmap(jax.random.fold_in, (0, None))(keys.reshape(-1), number)
        seeded = jax.random.key(number), jax.random.key(seed)
        moved = [jax.random.key_data(one) for one in (keys.T[1:], chosen, jnp.roll(keys, 1, 0), batch, *seeded)]
        return moved, keys == jnp.where(which, keys, keys.T), keys[0] != chosen

    def carried(words, number, which):
        scanned, _ = lax.scan(lambda key, _: (jax.random.split(key)[1], None), words, None, length=2)
        ended = lax.while_loop(
            lambda c: c[0] < number % 5, lambda c: (c[0] + 1, jax.random.fold_in(c[1], 3)), (0, jax.random.key(7))
        )
        return scanned, jax.random.key_data(ended[1]), ended[0]

    return draw(st.sampled_from([made, carried])), [
        integers(draw, (2,), "uint32"), integers(draw, ()), booleans(draw, ())
    ]  # fmt: skip


def draws_of_jax(draw: Draw) -> Case:
    """Bits are JAX's, and those of uniform numbers too."""
    of = shape(draw, most=2)

    def bits(words):
        drawn = [jax.random.bits(words, of, dtype) for dtype in (jnp.uint16, jnp.uint8)]
        return drawn, jax.random.bernoulli(words, 0.3, of)

    def uniform(words):
        drawn = jax.random.uniform(words, of), jax.random.uniform(words, (3,), minval=-0.05, maxval=0.3)
        return [lax.bitcast_convert_type(x, jnp.int32) for x in drawn]

    def whole(words):
        return jax.random.randint(words, of, -3, 9), jax.random.permutation(words, 4)

    one = draw(st.sampled_from([bits, uniform, whole]))
    return lambda words: (threefry_prng_impl.random_bits(words, 32, (2,)), one(words)), [integers(draw, (2,), "uint32")]


def normals_of_jax(draw: Draw) -> Case:
    return lambda key: (jax.random.normal(key, (4,)), jax.random.categorical(key, jnp.arange(3.0))), [
        integers(draw, (2,), "uint32")
    ]


CASES: dict[str, Callable[[Draw], Case]] = {
    "add": binary(jnp.add),
    "integer arithmetic": binary(lambda a, b: (a + b, a - b, a * b, -a, jnp.abs(a), lax.square(a)), integers),
    "terms of a gradient": unary(jax.grad(lambda x: (jnp.sin(x) * x).sum())),
    "sub": binary(jnp.subtract),
    "mul": binary(jnp.multiply),
    "div": binary(jnp.divide),
    "special values": binary(lambda a, b: (a + b, a - b, a * b, a / b, jnp.isfinite(a), jnp.sign(a)), special),
    "neg, abs, sign, square": unary(lambda x: (-x, jnp.abs(x), jnp.sign(x), lax.square(x))),
    "sqrt, rsqrt": unary(lambda x: (jnp.sqrt(x), lax.rsqrt(x)), 0.01, 9.0),
    "floor, ceil, round": unary(lambda x: (jnp.floor(x), jnp.ceil(x), jnp.round(x), lax.round(x))),
    "powers": unary(lambda x: (x**3, lax.integer_pow(x, -2), lax.integer_pow(x, 0), x**1.5), 0.5, 2.0),
    "trigonometry": unary(lambda x: (jnp.sin(x), jnp.cos(x), jnp.tan(x * 0.4), jnp.arctan(x))),
    "arcs": unary(lambda x: (jnp.arcsin(x), jnp.arccos(x)), -1.0, 1.0),
    "atan2": binary(jnp.arctan2),
    "exponentials": unary(lambda x: (jnp.exp(x), jnp.expm1(x), jnp.exp2(x), jnp.tanh(x), jax.nn.sigmoid(x))),
    "logarithms": unary(lambda x: (jnp.log(x), jnp.log1p(x)), 0.01, 9.0),
    "pow": lambda draw: (jnp.power, [floats(draw, (3,), 0.1, 3.0), floats(draw, (3,))]),
    "pow of whole numbers": lambda draw: (
        lambda x, n: lax.pow(x, n % 9 - 4),
        [floats(draw, (3,), 0.1, 3.0), integers(draw, (3,))],
    ),
    "clamp": lambda draw: (lambda x: jnp.clip(x, -1.0, 1.5), [special(draw, (4,))]),
    "lax.clamp": lambda draw: (lambda x: lax.clamp(np.float32(-1), x, np.float32(2)), [floats(draw, (4,))]),
    "of nothing": lambda draw: (
        lambda x: (
            x[:0].sum(0),
            x[:0].prod(0),
            x[:0].max(0, initial=-1.0),
            (x[:0] > 0).all(0),
            (x[:0] > 0).any(0),
            jnp.cumsum(x[:0]),
            x[:0].reshape(0, 2).T @ x[:0].reshape(0, 2),
            lax.pad(x, 0.0, [(-5, 4, 0)]),
        ),
        [floats(draw, (3,))],
    ),
    "bytes": lambda draw: (
        lambda x: jnp.bitwise_count(x)[::1].reshape(1, 3).astype(jnp.float32),
        [integers(draw, (3,), "uint32")],
    ),
    "cumulations": along(
        lambda x, axis, reverse: [f(x, axis, reverse) for f in (lax.cumsum, lax.cumprod, lax.cummax, lax.cummin)]
    ),
    "sums": reduction(lambda x, axes: (x.sum(axes), x.prod(axes))),
    "integer sums": reduction(lambda x, axes: x.sum(axes), integers),
    "extremes of axes": reduction(lambda x, axes: (x.max(axes), x.min(axes)), special),
    "all and any": reduction(lambda x, axes: (x.all(axes), x.any(axes)), booleans),
    "remainders": binary(lambda a, b: (lax.rem(a, b), jnp.mod(a, b), a // 1.5)),
    "division of integers": binary(lambda a, b: (a // b, a % b, lax.div(a, b), lax.rem(a, b)), integers),
    "division without signs": binary(
        lambda a, b: (a // b, a % b, lax.div(a, b), lax.rem(a, b)), lambda draw, of: integers(draw, of, "uint32")
    ),
    "signs of integers": binary(lambda a, b: jnp.sign(a - b), integers),
    "arg extremes of others": arg_extremes,
    "select": selections,
    "arg extremes": lambda draw: (lambda x: (jnp.argmin(x, 0), jnp.argmax(x, 0)), [special(draw, (4, 2))]),
    "dots": dots,
    "gather": index_cases.gather,
    "gather along": index_cases.gather_along,
    "gather by data": index_cases.gather_by_data,
    "places by data": index_cases.places_by_data,
    "scatter": index_cases.scatter,
    "scatter by data": index_cases.scatter_by_data,
    "updates by data": index_cases.updates_by_data,
    "segment sum": index_cases.segment_sum,
    "slices": slices,
    "dynamic": index_cases.dynamic,
    "pads": pads,
    "empty arrays": lambda draw: (
        lambda x, i: (jnp.empty((2, 3)), jnp.empty(x.shape, bool), jnp.empty_like(i).at[1:].set(i[1:])),
        [floats(draw, (3,)), integers(draw, (3,))],
    ),
    "moves": moves,
    "choices": choices,
    "integer choice": lambda draw: (
        lambda i, x: lax.select_n(jnp.clip(i, 0, 2), x, x * 2, x * 3),
        [integers(draw, ()), floats(draw, ())],
    ),
    "branches": branches,
    "scans": scans,
    "loops": loops,
    "loops by data": loops_by_data,
    "conversions": conversions,
    "compares": compares,
    "boolean compares": binary(lambda a, b: (a == b, a != b), booleans),
    "extremes": extremes,
    "constant integers": constant_integers,
    "calls": calls,
    "sorts": sorts,
    "sorts of constants": sorts_of_constants,
    "greatest": greatest,
    "cholesky": cholesky,
    "triangular solve": triangular_solve,
    "solves of trees": solves_of_trees,
    "bits": bits,
    "narrow integers": narrow,
    "shifts": shifts,
    "orders": orders,
    "keys of JAX": keys_of_jax,
    "draws of JAX": draws_of_jax,
    "normals of JAX": normals_of_jax,
}
