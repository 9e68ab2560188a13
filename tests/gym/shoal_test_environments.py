"""Environments for the tests, some of which fail or cannot be served."""

import json
import os
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np


class Ends(gym.Env):
    """Terminates after ``after`` steps, unless the time limit of 5 comes first.

    Its rewards and observations depend on its seed.
    """

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
    """Fails in its fourth step."""

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
    """Starts a long-lived process that keeps standard error open."""

    def __init__(self, alone=False):
        super().__init__(after=0)
        self.child = subprocess.Popen(["sleep", "54321"], start_new_session=alone)


class Tells(Ends):
    """Tells in a file where and how it was started."""

    def __init__(self, **arguments):
        super().__init__(after=0)
        with open("told", "a") as told:
            variables = [os.environ.get(name) for name in ("PYTHONHASHSEED", "OMP_NUM_THREADS")]
            told.write(f"{' '.join(map(str, variables))} {sorted(arguments.items())}\n")


class Talks(Ends):
    """Writes endlessly to standard error, or writes terminal control sequences."""

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
    """Hangs in a step once a file ``sleep`` exists, or with ``from_the_start`` in its constructor.

    It creates the file ``asleep`` when it hangs in a step.
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
    """Observations start at 5 and actions at -1.

    Actions 0, 1, 0 lead from 5 to 8, each with a reward of 1. Any other action terminates the episode.
    """

    observation_space = gym.spaces.Discrete(4, start=5)
    action_space = gym.spaces.Discrete(3, start=-1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = 5
        return self.state, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        is_right = action == (1 if self.state == 6 else 0)
        self.state += is_right
        return self.state, float(is_right), bool(not is_right or self.state == 8), False, {}


class Invalid(gym.Env):
    """Returns something invalid: once in this working directory, or always until there is a file ``mended``."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, what, always=False):
        self.what, self.always, self.taken = what, always, 0

    def _now(self):
        if self.always:
            return not os.path.exists("mended")
        if self.taken != 40 or os.path.exists(f"returned-{self.what}"):
            return False
        with open(f"returned-{self.what}", "w"):
            return True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.taken += 1
        observation, reward, terminated = np.zeros(3, np.float32), 0.0, False
        if self._now():
            match self.what:
                case "nan-reward":
                    reward = float("nan")
                case "none-reward":
                    reward = None
                case "nan-observation":
                    observation[1] = np.nan
                case "shape":
                    observation = np.zeros(1, np.float32)
                case "terminated":
                    terminated = 2
        return observation, reward, terminated, False, {}


gym.register("Invalid-v0", entry_point=Invalid, max_episode_steps=5)


class Finale(Ends):
    """Fails in the final evaluation, when the run in ``run`` has its last policy: once, always, or by sleeping."""

    def __init__(self, how):
        super().__init__(after=0)
        self.how = how

    def step(self, action):
        # Actors may still step when the last policy is written.
        in_run = "config/iceoryx2.toml" in open("/proc/self/cmdline").read()
        if os.path.exists("run/checkpoints/last.policy") and not in_run:
            first = not os.path.exists("final")
            open("final", "w").close()
            if self.how == "sleeps":
                time.sleep(54321)
            if self.how == "always" or first:
                raise RuntimeError("the last act fails")
        return super().step(action)


class Grows(Ends):
    """Every episode has a greater return than those before."""

    def __init__(self):
        super().__init__(after=0)
        self.resets = 0

    def reset(self, *, seed=None, options=None):
        self.resets += 1
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(self.resets), *rest


class Draws(Ends):
    """Shows its step as the height of a red column in a picture of 60 by 40 pixels; with ``dies`` its server is killed
    once, in the third step of a film or always."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None, dies="never"):
        super().__init__(after=0)
        self.render_mode, self.dies = render_mode, dies

    def step(self, action):
        is_filmed = "SHOAL_PICTURES" in os.environ
        if is_filmed and self.steps == 2 and (self.dies == "always" or self.dies == "once" and not os.path.exists("died")):
            open("died", "w").close()
            os.kill(os.getpid(), 9)
        return super().step(action)

    def render(self):
        picture = np.full((40, 60, 3), 255, np.uint8)
        picture[40 - 6 * (self.steps + 1) :, 20:30] = (200, 0, 0)
        return picture


gym.register("Draws-v0", entry_point=Draws, max_episode_steps=5)
gym.register("Grows-v0", entry_point=Grows, max_episode_steps=5)
gym.register("Finale-v0", entry_point=Finale, max_episode_steps=5)
gym.register("Ends-v0", entry_point=Ends, max_episode_steps=5)
gym.register("Endless-v0", entry_point=Ends)
gym.register("Fails-v0", entry_point=Fails, max_episode_steps=5)
gym.register("Parent-v0", entry_point=Parent, max_episode_steps=5)
gym.register("Tells-v0", entry_point=Tells, max_episode_steps=5)
gym.register("Talks-v0", entry_point=Talks, max_episode_steps=5)
gym.register("Sleeps-v0", entry_point=Sleeps, max_episode_steps=5)
gym.register("Odd-v0", entry_point=Odd, max_episode_steps=5)
gym.register("Offset-v0", entry_point=Offset, max_episode_steps=5)


def deaf_server():
    """An environment server that keeps running but ignores requests while a file ``deaf`` exists."""
    from shoal_gym import port

    original = port.Port.next_request

    def next_request(self):
        while os.path.exists("deaf"):
            self._check_end()
            self.beat(port.Activity.WAITING_FOR_PEER)
            time.sleep(0.05)
        return original(self)

    port.Port.next_request = next_request
    from shoal_gym.__main__ import main

    return main()


def hostile_server(how):
    """An environment server whose answers are wrong now and then, and which does not check them."""
    from shoal_gym import server

    luck = np.random.default_rng(1)
    send = server.Server._send

    def wrong(self, response, status):
        numbers = server._numbers(response.payload())
        if len(numbers) > 10 and luck.random() < 0.2:
            match how:
                case "nan":
                    numbers[luck.integers(len(numbers))] = np.nan
                case "flags":
                    numbers[-1] = 0.5
                case "huge":
                    numbers[:] = np.inf
                case "status":
                    status = 77
        send(self, response, status)

    def another_length(self, request):
        response, blocks = loan_blocks(self, request)
        if luck.random() < 0.1:
            return self._loan(request, 3 if how == "short" else 9), blocks
        return response, blocks

    def twice(self, request):
        answer(self, request)
        if luck.random() < 0.2:
            self._send(self._loan(request, 0), server.ResponseStatus.REFUSED)

    server.Server._send = wrong
    loan_blocks, answer = server.Server._loan_blocks, server.Server.answer
    if how in ("short", "long"):
        server.Server._loan_blocks = another_length
    if how == "twice":
        server.Server.answer = twice
    from shoal_gym.__main__ import main

    return main()


def endless_server():
    """An environment server that never reports the end of an episode."""
    from shoal_gym import environments

    step = environments.Environments.step

    def endless(self, actions, blocks):
        step(self, actions, blocks)
        blocks.terminated[:] = 0
        blocks.truncated[:] = 0

    environments.Environments.step = endless
    from shoal_gym.__main__ import main

    return main()


def spoilt_server():
    """An environment server whose rewards are no numbers in the first training episode of the first environment."""
    from shoal_gym import environments

    step = environments.Environments.step

    def spoilt(self, actions, blocks):
        step(self, actions, blocks)
        if self._purpose is environments.Purpose.TRAINING and self._slots[0].episode == 0:
            blocks.rewards[:] = np.nan

    environments.Environments.step = spoilt
    from shoal_gym.__main__ import main

    return main()


def holding_server(episodes):
    """An environment server that creates the file ``held`` and waits for the file ``go`` when it is first asked for other
    evaluation episodes than the first ``episodes``."""
    from shoal_gym import environments

    begin = environments.Environments.begin_evaluation

    def begin_evaluation(self, first, count, blocks):
        if first >= episodes and not os.path.exists("held"):
            open("held", "w").close()
            while not os.path.exists("go"):
                time.sleep(0.01)
        begin(self, first, count, blocks)

    environments.Environments.begin_evaluation = begin_evaluation
    from shoal_gym.__main__ import main

    return main()


def scripted_server(plan):
    """An environment server that spoils its answers to one client by a plan, and does not check them.

    Each fault is done with its chance, and at most ``times`` times by all servers in this directory together.
    """
    from shoal_gym import server

    plan = json.loads(plan)
    luck = np.random.default_rng(plan["seed"])
    if not sys.argv[sys.argv.index("--client") + 1].startswith(plan["client"]):
        plan["faults"] = []

    def is_due(fault):
        if luck.random() >= fault["chance"]:
            return False
        for time_of in range(fault["times"]):
            try:
                os.close(os.open(f"{fault['what']}-{time_of}", os.O_CREAT | os.O_EXCL))
                return True
            except FileExistsError:
                pass
        return False

    def due(*kinds):
        return [fault for fault in plan["faults"] if fault["what"] in kinds and is_due(fault)]

    send, loan_blocks, answer = server.Server._send, server.Server._loan_blocks, server.Server.answer
    header = server.ResponseHeader

    def spoiled(self, response, status):
        numbers = server._numbers(response.payload())
        for fault in due("number", "numbers", "status"):
            match fault["what"]:
                case "number" if len(numbers) > 0:
                    numbers[luck.integers(len(numbers))] = fault["number"]
                case "numbers":
                    numbers[:] = fault["number"]
                case "status":
                    status = fault["count"]
        send(self, response, status)

    def another_length(self, request):
        response, blocks = loan_blocks(self, request)
        for fault in due("length"):
            return self._loan(request, fault["count"]), blocks
        return response, blocks

    def another_header(**fields):
        for fault in due("header"):
            fields[list(fields)[1 + fault["count"] % 7]] = fault["count"]
        return header(**fields)

    def answered(self, request):
        for fault in due("none", "late", "exit", "refused"):
            match fault["what"]:
                case "none":
                    return
                case "late":
                    time.sleep(fault["count"] / 10)
                case "exit":
                    os._exit(fault["count"])
                case "refused":
                    self._refuse(request, "it does not like it")
                    return
        answer(self, request)
        for fault in due("twice"):
            self._send(self._loan(request, fault["count"]), server.ResponseStatus.ANSWERED)

    server.Server._send, server.Server._loan_blocks, server.Server.answer = spoiled, another_length, answered
    server.ResponseHeader = another_header
    from shoal_gym.__main__ import main

    return main()
