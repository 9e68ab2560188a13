"""Environments that end, fail and cannot be served, for the tests."""

import os
import subprocess
import time

import gymnasium as gym
import numpy as np


class Ends(gym.Env):
    """Ends by itself after ``after`` steps, if the time limit of 5 does not end it before; says what it was seeded with."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2, 2))
    action_space = gym.spaces.Box(np.array([-2, 0], np.float32), np.array([2, 1], np.float32))

    def __init__(self, after=3):
        self.after = after

    def _observation(self):
        return np.array([[self.start, self.steps], [0, 1]], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.start, self.steps = self.np_random.uniform(), 0
        return self._observation(), {}

    def step(self, action):
        assert action.shape == (2,) and self.action_space.contains(action), action
        self.steps += 1
        return self._observation(), 10.0 * self.start, self.steps == self.after, False, {}


class Fails(Ends):
    """Goes wrong in its fourth step."""

    def __init__(self, how):
        super().__init__(after=0)
        self.how = how

    def step(self, action):
        if self.steps == 3 and self.how == "raise":
            raise RuntimeError("the motor is on fire")
        if self.steps == 3 and self.how == "abort":
            os.abort()
        return super().step(action)


class Parent(Ends):
    """Has started a process that lives for long and keeps standard error open."""

    def __init__(self, alone=False):
        super().__init__(after=0)
        self.child = subprocess.Popen(["sleep", "54321"], start_new_session=alone)


class Talks(Ends):
    """Writes to standard error without an end, or what a terminal takes for commands."""

    def __init__(self, how):
        super().__init__(after=0)
        self.how = how

    def step(self, action):
        if self.how == "flood":
            os.write(2, b"x" * 1_000_000)
        else:
            os.write(2, b"\x1b]0;owned\x07\n")
        return super().step(action)


class Sleeps(Ends):
    """Does not come back from a step, once there is a file of the name ``sleep``, or from being made.

    The file ``asleep`` says that it sleeps in a step.
    """

    def __init__(self, from_the_start=False):
        super().__init__(after=0)
        if from_the_start:
            time.sleep(54321)

    def step(self, action):
        if os.path.exists("sleep"):
            open("asleep", "w").close()
            time.sleep(54321)
        return super().step(action)


class Odd(Ends):
    observation_space = gym.spaces.Dict({"position": gym.spaces.Box(-1, 1, (1,))})


class Offset(gym.Env):
    """Counts from 5 observations and from -1 actions; from 5 to 8 lead actions 0, 1, 0, each for a reward, and others end."""

    observation_space = gym.spaces.Discrete(4, start=5)
    action_space = gym.spaces.Discrete(3, start=-1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = 5
        return self.state, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        leads_on = action == (1 if self.state == 6 else 0)
        self.state += leads_on
        return self.state, float(leads_on), bool(not leads_on or self.state == 8), False, {}


class Finale(Ends):
    """Fails in the final evaluation, when the run in ``run`` has its last policy: once, always, or by sleeping."""

    def __init__(self, how):
        super().__init__(after=0)
        self.how = how

    def step(self, action):
        # Actors may still step when the last policy is written.
        in_run = "run/config/iceoryx2.toml" in open("/proc/self/cmdline").read()
        if os.path.exists("run/checkpoints/last.policy") and not in_run:
            first = not os.path.exists("final")
            open("final", "w").close()
            if self.how == "sleeps":
                time.sleep(54321)
            if self.how == "always" or first:
                raise RuntimeError("the last act fails")
        return super().step(action)


gym.register("Finale-v0", entry_point=Finale, max_episode_steps=5)
gym.register("Ends-v0", entry_point=Ends, max_episode_steps=5)
gym.register("Endless-v0", entry_point=Ends)
gym.register("Fails-v0", entry_point=Fails, max_episode_steps=5)
gym.register("Parent-v0", entry_point=Parent, max_episode_steps=5)
gym.register("Talks-v0", entry_point=Talks, max_episode_steps=5)
gym.register("Sleeps-v0", entry_point=Sleeps, max_episode_steps=5)
gym.register("Odd-v0", entry_point=Odd, max_episode_steps=5)
gym.register("Offset-v0", entry_point=Offset, max_episode_steps=5)


def deaf_server():
    """An environment server that goes on living and stops hearing, once there is a file of the name ``deaf``."""
    from shoal_gym import port

    hear = port.Port.next_request

    def next_request(self):
        while os.path.exists("deaf"):
            self._look_out()
            self.beat(port.Activity.WAITING_FOR_PEER)
            time.sleep(0.05)
        return hear(self)

    port.Port.next_request = next_request
    from shoal_gym.__main__ import main

    return main()
