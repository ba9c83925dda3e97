"""Random loops, as kernels in chunks and as plain scans: a process of its own, which XLA may end.

python tests/random_loops.py FIRST LAST      prints one line for each seed, then "same"
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxquad.simulation import run_ensemble


jax.config.update("jax_enable_x64", True)

SCALAR = [  # of members: x, y, z numbers, b a condition, k an integer, c a constant, s shared
    lambda x, y, z, b, k, c, s: x + c * y,
    lambda x, y, z, b, k, c, s: jnp.tanh(x * y),
    lambda x, y, z, b, k, c, s: jnp.sin(x) / (1.5 + y * y),
    lambda x, y, z, b, k, c, s: jnp.where(b, x, z),
    lambda x, y, z, b, k, c, s: jnp.where(k == k, x, y) + (k % 3).astype(x.dtype) * z,
    lambda x, y, z, b, k, c, s: jnp.clip(x, -0.5, c + 1.6) + jnp.minimum(y, z),
    lambda x, y, z, b, k, c, s: jnp.sqrt(1 + x * x) + s[1] * y,
    lambda x, y, z, b, k, c, s: 0 * x + jnp.arctan2(y, 1 + z * z),
    lambda x, y, z, b, k, c, s: jax.lax.fori_loop(0, 3, lambda _, u: 0.5 * u + jnp.cos(x) * y, z),
    lambda x, y, z, b, k, c, s: jax.lax.cond(s[0] > 0, lambda: x * y, lambda: x + 0.1 * z),
    lambda x, y, z, b, k, c, s: jnp.where(jnp.isnan(x), 0.0, x) + jax.lax.stop_gradient(y),
]
VECTOR = [  # of [3, members]
    lambda v, w, x: 0.5 * v + w * x,
    lambda v, w, x: jnp.cross(v, w, axis=0),
    lambda v, w, x: jnp.roll(v, 1, axis=0) - jnp.max(jnp.abs(w), axis=0),
    lambda v, w, x: jnp.stack([x, jnp.sum(v, axis=0), w[2]]),
]


def random_step(rng, length=24):
    plan = [(*rng.integers(0, 10**6, 6), rng.uniform(-1, 1)) for _ in range(length)]

    def step(carry, parts, now):
        x, v, k = carry
        shared, own = parts
        numbers, vectors, wholes = [x, *v, *own, now + 0 * x], [v, 0.0 * v], [k]
        truths = [x > 0, jnp.zeros(x.shape, bool)]
        for kind, i, j, l, b, m, c in plan:
            y, z, w = (numbers[n % len(numbers)] for n in (i, j, l))
            if kind % 4 == 3:
                pair = (vectors[n % len(vectors)] for n in (i, j))
                vectors.append(VECTOR[m % len(VECTOR)](*pair, w))
                wholes.append(wholes[i % len(wholes)] * 2 + k)
            else:
                of = SCALAR[m % len(SCALAR)]
                condition, whole = truths[b % len(truths)], wholes[b % len(wholes)]
                numbers.append(of(y, z, w, condition, whole, c, shared))
                truths.append((y < z) & ~condition)
        total = numbers[-1] + 0.5 * numbers[len(numbers) // 2] + vectors[-1][0]
        after = jnp.tanh(0.3 * vectors[-1] + 0.2 * vectors[len(vectors) // 2]) + 0.1 * v
        return (jnp.tanh(0.5 * total) + 0.5 * x, after, (k + wholes[-1]) % 5), (total, truths[-1])

    return step


def compare(seed):
    rng = np.random.default_rng(seed)
    members, samples, chunk = (int(rng.choice(x)) for x in ([3, 64, 130], [20, 131], [48, 128]))
    draw, step = lambda *shape: jnp.asarray(rng.normal(size=shape) / 2), random_step(rng)
    carry = (draw(members), draw(3, members), jnp.asarray(rng.integers(0, 5, members)))
    parts, signal = (draw(2), draw(2, members)), draw(samples)

    def fast(carry, parts):
        return run_ensemble(
            step, carry, parts, signal, of_members=((False, True), False), chunk=chunk
        )

    def plain(carry, parts):
        return jax.lax.scan(lambda carry, now: step(carry, parts, now), carry, signal)

    def both(run):
        def cost(start, parts):
            last, stored = run((start, *carry[1:]), parts)
            return jnp.sum(last[0] ** 2) + jnp.sum(last[1]) + jnp.sum(jnp.sin(stored[0]))

        slope = jax.grad if seed % 2 else jax.value_and_grad  # without the value, no forward result
        whole = lambda *args: (run((args[0], *carry[1:]), args[1]), slope(cost, (0, 1))(*args))
        return jax.jit(whole)(carry[0], parts)

    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)  # ill-conditioned
    jax.tree.map(same, both(fast), both(plain))
    print(seed, members, samples, chunk, flush=True)


if __name__ == "__main__":
    for seed in range(*map(int, sys.argv[1:3])):
        compare(seed)
    print("same")
