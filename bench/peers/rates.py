"""Rates of other software on this machine.

Measures DDPG gradient steps per second in JAX and PyTorch, and environment steps per second of Gymnasium's vectors.

    pip install jax torch gymnasium==1.4.0
    OMP_NUM_THREADS=1 taskset -c 1 python bench/peers/rates.py learner
    python bench/peers/rates.py actors

Compare with `shoal bench learner` and `shoal bench actors`, run right before or after. Networks, batch size and
learning rates are those of the thesis, section 4.3.1. An update does the same as in Shoal: it samples 64 rows of a
million and updates critic, actor and both targets. JAX samples and makes 32 updates per call, the fastest variant
found. PyTorch flushes denormal numbers, without which it gets much slower, and uses fused Adam and a fused target
update. `torch.compile` of this code was slower. The actors' policy is in PyTorch, with 64 environments per vector. The
last line of standard output is one JSON object.
"""

import argparse
import json
import os
import statistics
import time

# One thread, as in the measurement of Shoal's learner. Must be set before JAX is imported.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import numpy as np

OBSERVATION, ACTION, HIDDEN, BATCH = 3, 1, (400, 300), 64
GAMMA, TAU, ACTOR_RATE, CRITIC_RATE = 0.99, 0.001, 1e-4, 1e-3
ROWS = 1_000_000
WINDOWS, SECONDS = 5, 3.0
ENVIRONMENTS = 64


class Replay:
    """A replay of random rows s, a, r, s'."""

    def __init__(self):
        self.random = np.random.default_rng(1)
        self.rows = self.random.standard_normal((ROWS, 2 * OBSERVATION + ACTION + 1), dtype=np.float32)

    def sample(self, *shape):
        return self.rows.take(self.random.integers(0, ROWS, shape), axis=0)


def rate(work, each):
    """The median rate over several windows, after a warm-up. Each call of `work` counts as `each` units."""
    rates = []
    for _ in range(WINDOWS + 1):
        done, begun = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - begun) < SECONDS:
            work()
            done += each
        rates.append(done / elapsed)
    return statistics.median(rates[1:])


def initial(sizes, random):
    """Initial weights (inputs x outputs) and biases of the layers."""
    bound = [1 / np.sqrt(inputs) for inputs, _ in sizes]
    draw = lambda shape, b: random.uniform(-b, b, shape).astype(np.float32)
    return [draw(shape, b) for size, b in zip(sizes, bound) for shape in (size, size[1:])]


ACTOR_SIZES = [(OBSERVATION, HIDDEN[0]), HIDDEN, (HIDDEN[1], ACTION)]
CRITIC_SIZES = [(OBSERVATION, HIDDEN[0]), (HIDDEN[0] + ACTION, HIDDEN[1]), (HIDDEN[1], 1)]


def jax_updates(replay, together=32):
    import jax
    import jax.numpy as jnp

    def mu(w, s):
        return 2 * jnp.tanh(jax.nn.relu(jax.nn.relu(s @ w[0] + w[1]) @ w[2] + w[3]) @ w[4] + w[5])

    def q(w, s, a):
        h = jax.nn.relu(s @ w[0] + w[1])
        return jax.nn.relu(h @ w[2][: HIDDEN[0]] + a @ w[2][HIDDEN[0] :] + w[3]) @ w[4] + w[5]

    def descend(w, gradient, m, v, t, step):
        m = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, m, gradient)
        v = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, v, gradient)
        move = lambda w, m, v: w - step / (1 - 0.9**t) * m / (jnp.sqrt(v / (1 - 0.999**t)) + 1e-8)
        return jax.tree.map(move, w, m, v), m, v

    def follow(target, w):
        return jax.tree.map(lambda target, w: target + TAU * (w - target), target, w)

    def update(state, rows):
        t, actor, critic, target_actor, target_critic, am, av, cm, cv = state
        s, a, r, s_next = jnp.split(rows, (OBSERVATION, OBSERVATION + ACTION, OBSERVATION + ACTION + 1), axis=1)
        t = t + 1
        y = r + GAMMA * q(target_critic, s_next, mu(target_actor, s_next))
        gradient = jax.grad(lambda w: jnp.mean((q(w, s, a) - y) ** 2))(critic)
        critic, cm, cv = descend(critic, gradient, cm, cv, t, CRITIC_RATE)
        gradient = jax.grad(lambda w: -jnp.mean(q(critic, s, mu(w, s))))(actor)
        actor, am, av = descend(actor, gradient, am, av, t, ACTOR_RATE)
        return (t, actor, critic, follow(target_actor, actor), follow(target_critic, critic), am, av, cm, cv), None

    many = jax.jit(lambda state, rows: jax.lax.scan(update, state, rows, unroll=4)[0], donate_argnums=0)
    fresh = lambda sizes: jax.tree.map(jnp.asarray, initial(sizes, np.random.default_rng(2)))
    zeros = lambda sizes: jax.tree.map(jnp.zeros_like, fresh(sizes))
    moments = [zeros(sizes) for sizes in (ACTOR_SIZES, ACTOR_SIZES, CRITIC_SIZES, CRITIC_SIZES)]
    networks = [fresh(sizes) for sizes in (ACTOR_SIZES, CRITIC_SIZES, ACTOR_SIZES, CRITIC_SIZES)]
    state = (jnp.float32(0), *networks, *moments)

    def work():
        nonlocal state
        state = jax.block_until_ready(many(state, replay.sample(together, BATCH)))

    return rate(work, together)


def torch_updates(replay):
    import torch

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    relu = torch.relu

    def mu(w, s):
        return 2 * torch.tanh(relu(relu(s @ w[0] + w[1]) @ w[2] + w[3]) @ w[4] + w[5])

    def q(w, s, a):
        return relu(torch.cat([relu(s @ w[0] + w[1]), a], 1) @ w[2] + w[3]) @ w[4] + w[5]

    fresh = lambda sizes: [torch.from_numpy(w).requires_grad_() for w in initial(sizes, np.random.default_rng(2))]
    actor, critic = fresh(ACTOR_SIZES), fresh(CRITIC_SIZES)
    target_actor, target_critic = ([w.detach().clone() for w in network] for network in (actor, critic))
    adams = [
        torch.optim.Adam(network, lr=step, fused=True) for network, step in ((actor, ACTOR_RATE), (critic, CRITIC_RATE))
    ]

    def loss_of_critic(s, a, r, s_next):
        with torch.no_grad():
            y = r + GAMMA * q(target_critic, s_next, mu(target_actor, s_next))
        return torch.nn.functional.mse_loss(q(critic, s, a), y)

    def loss_of_actor(s):
        return -q([w.detach() for w in critic], s, mu(actor, s)).mean()

    def work():
        rows = torch.from_numpy(replay.sample(BATCH))
        s, a, r, s_next = rows.split((OBSERVATION, ACTION, 1, OBSERVATION), dim=1)
        for adam, loss in ((adams[1], lambda: loss_of_critic(s, a, r, s_next)), (adams[0], lambda: loss_of_actor(s))):
            adam.zero_grad()
            loss().backward()
            adam.step()
        with torch.no_grad():
            torch._foreach_lerp_(target_actor, actor, TAU)
            torch._foreach_lerp_(target_critic, critic, TAU)

    return rate(work, 1)


def rows_of_gymnasium(mode):
    """Environment steps per second of environments and policy only: no noise, no rows written."""
    import gymnasium
    import torch

    network = [torch.from_numpy(w) for w in initial(ACTOR_SIZES, np.random.default_rng(2))]
    vector = gymnasium.make_vec("Pendulum-v1", num_envs=ENVIRONMENTS, vectorization_mode=mode)
    observations, _ = vector.reset(seed=1)

    def work():
        nonlocal observations
        with torch.no_grad():
            h = torch.relu(torch.addmm(network[1], torch.from_numpy(observations), network[0]))
            h = torch.relu(torch.addmm(network[3], h, network[2]))
            actions = 2 * torch.tanh(torch.addmm(network[5], h, network[4]))
        observations = vector.step(actions.numpy())[0]

    result = rate(work, ENVIRONMENTS)
    vector.close()
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["learner", "actors"])
    if parser.parse_args().what == "learner":
        replay = Replay()
        results = {
            "jax_updates_per_second": jax_updates(replay),
            "torch_updates_per_second": torch_updates(replay),
        }
    else:
        results = {f"{mode}_vector_rows_per_second": rows_of_gymnasium(mode) for mode in ("sync", "async")}
    print(json.dumps(results))


if __name__ == "__main__":
    main()
