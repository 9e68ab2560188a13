"""What environments may and may not return, and what they are given."""

import os
import random
import unittest
from typing import Any

import gymnasium as gym
import numpy as np

from shoal_gym import spaces
from shoal_gym.environments import SEEDS, Blocks, Environments
from shoal_gym.spaces import Invalid

BOX = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)


class ScriptedEnvironment(gym.Env[Any, Any]):
    """Returns what it is told to, and notes what it is given."""

    observation_space = BOX
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    reset_result: Any = (np.zeros(3, np.float32), {})
    step_result: Any = (np.zeros(3, np.float32), 0.0, False, False, {})
    given: list[Any] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        ScriptedEnvironment.given.append(seed)
        return ScriptedEnvironment.reset_result

    def step(self, action: Any) -> Any:
        ScriptedEnvironment.given.append(action)
        return ScriptedEnvironment.step_result


gym.register("Scripted-v0", entry_point=ScriptedEnvironment, max_episode_steps=1000)


class EnvironmentsTest(unittest.TestCase):
    def setUp(self) -> None:
        ScriptedEnvironment.observation_space = BOX
        ScriptedEnvironment.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        ScriptedEnvironment.reset_result = (np.zeros(3, np.float32), {})
        ScriptedEnvironment.step_result = (np.zeros(3, np.float32), 0.0, False, False, {})
        ScriptedEnvironment.given = []

    def make(self, count: int = 1, seed: int = 7) -> tuple[Environments, Blocks]:
        environments = Environments("Scripted-v0", {"disable_env_checker": True}, count, seed, 2, 0)
        width = environments.observation.width
        response = np.full(Blocks.length(count, width), np.nan, np.float32)
        return environments, Blocks.of(response, count, width)

    def step(self, environments: Environments, blocks: Blocks) -> None:
        numbers = np.zeros(len(environments) * environments.action.width, np.float32)
        environments.step(environments.action.decode(numbers), blocks)

    def refused(self, result: Any, *words: str) -> None:
        """A step that returns this is refused in these words, and where it was is stated."""
        environments, blocks = self.make()
        environments.begin_next(blocks)
        ScriptedEnvironment.step_result = result
        with self.assertRaises(Invalid) as caught:
            self.step(environments, blocks)
        for word in [*words, "Scripted-v0", "environment 0, training episode 0, step 1"]:
            self.assertIn(word, str(caught.exception))
        self.assertNotIn("\n", str(caught.exception))

    def test_observations_that_are_no_elements_of_their_space_are_refused(self) -> None:
        def with_observation(observation: Any) -> Any:
            return observation, 0.0, False, False, {}

        self.refused(with_observation(np.zeros(1, np.float32)), "shape (1,)", "shape (3,)")
        self.refused(with_observation(0.5), "shape ()", "shape (3,)")
        self.refused(with_observation(np.zeros((1, 1, 3))), "shape (1, 1, 3)")
        self.refused(with_observation(np.array([0.0, np.nan, 0.0])), "number 1 is nan")
        self.refused(with_observation(np.array([0.0, 0.0, np.inf])), "number 2 is inf")
        self.refused(with_observation(np.array([1e39, 0.0, 0.0])), "number 0 is 1e+39")
        self.refused(with_observation([[0.0], [0.0, 0.0], 0.0]), "no array of numbers")
        self.refused(with_observation(None), "shape ()")
        self.refused(with_observation(np.array(["a", "b", "c"])), "instead of numbers")
        self.refused(with_observation(np.zeros(3, complex)), "instead of numbers")

    def test_rewards_that_are_no_numbers_are_refused(self) -> None:
        def with_reward(reward: Any) -> Any:
            return np.zeros(3), reward, False, False, {}

        for reward, word in [
            (float("nan"), "nan"),
            (float("inf"), "inf"),
            (1e39, "1e+39"),
            (10**400, "not finite"),
            (None, "None"),
            ("much", "much"),
            (np.zeros(1), "array"),
            (1j, "1j"),
        ]:
            self.refused(with_reward(reward), "reward", word)

    def test_flags_that_are_not_booleans_are_refused(self) -> None:
        for value in [2, None, "no", 0.5, np.zeros(2, bool)]:
            self.refused((np.zeros(3), 0.0, value, False, {}), "terminated", "instead of a boolean")
            self.refused((np.zeros(3), 0.0, False, value, {}), "truncated", "instead of a boolean")

    def test_a_reset_that_returns_no_pair_is_refused(self) -> None:
        for result in [np.zeros(3), np.zeros(2), (np.zeros(3),), (np.zeros(3), None), None]:
            environments, blocks = self.make()
            ScriptedEnvironment.reset_result = result
            with self.assertRaisesRegex(Invalid, "Scripted-v0: reset returned something else than a pair"):
                environments.begin_next(blocks)

    def test_valid_results_are_accepted_in_any_ordinary_type(self) -> None:
        environments, blocks = self.make()
        environments.begin_next(blocks)
        for result in [
            (np.zeros(3, np.float64), np.float32(0.5), np.bool_(False), np.bool_(False), {}),
            ([0, 0, 0], 1, False, False, {}),
            (np.zeros(3, np.int8), np.array(0.25), 0, np.array(False), None),
        ]:
            ScriptedEnvironment.step_result = result
            self.step(environments, blocks)
        self.assertEqual(blocks.rewards[0], 0.25)
        ScriptedEnvironment.step_result = (np.ones(3), 1.0, True, True, {})
        self.step(environments, blocks)
        self.assertEqual((blocks.terminated[0], blocks.truncated[0]), (1.0, 0.0))
        self.assertEqual(blocks.next_observations.tolist(), [[1.0] * 3])
        self.assertEqual(blocks.observations.tolist(), [[0.0] * 3], "the next episode's first")

    def test_indices_outside_their_space_are_refused(self) -> None:
        ScriptedEnvironment.observation_space = gym.spaces.Discrete(4, start=1)
        ScriptedEnvironment.reset_result = (1, {})
        for value, words in [(0, "1 to 4"), (5, "1 to 4"), (2.7, "integers"), (np.array([2]), "integers")]:
            self.refused((value, 0.0, False, False, {}), words)
        for value in [float("inf"), float("nan"), 10**400]:
            self.refused((value, 0.0, False, False, {}), "integers")
        environments, blocks = self.make()
        environments.begin_next(blocks)
        ScriptedEnvironment.step_result = (np.int64(4), 0.0, False, False, {})
        self.step(environments, blocks)
        self.assertEqual(blocks.observations[0, 0], 3.0)
        self.assertEqual([bound.tolist() for bound in environments.observation.bounds()], [[1.0]])

    def test_actions_are_elements_of_their_space(self) -> None:
        for space, numbers in [
            (gym.spaces.Box(0.05, 1.0, (1,), np.float32), [0.04999998, 0.05, 1.0, 1.0000001]),
            (gym.spaces.Box(-0.1, 0.1, (1,), np.float64), [-0.1, 0.1, 0.05, 0.0]),
            (gym.spaces.Box(0, 3, (1,), np.int64), [0.0, 1.4, 2.6, 3.0]),
            (gym.spaces.Box(0, 255, (1,), np.uint8), [-1.0, 254.7, 255.0, 300.0]),
            (gym.spaces.Discrete(3, start=-1), [0.0, 1.0, 2.0, 0.0]),
        ]:
            codec = spaces.codec_of(space, "actions")
            elements = codec.decode(np.array(numbers, np.float32))
            for element in elements:
                self.assertTrue(space.contains(element), f"{element!r} is not in {space}")
        counted = spaces.codec_of(gym.spaces.Box(0, 3, (1,), np.int64), "actions")
        self.assertEqual(counted.decode(np.array([2.6], np.float32)).tolist(), [[3]])
        with self.assertRaises(ValueError):
            counted.decode(np.array([np.nan], np.float32))

    def test_an_evaluation_resets_each_environment_once_for_each_of_its_episodes(self) -> None:
        environments, blocks = self.make(count=2)
        environments.begin_evaluation(10, 3, blocks)
        ScriptedEnvironment.step_result = (np.ones(3), 1.0, True, False, {})
        seeds = []
        for _ in range(4):
            self.step(environments, blocks)
        seeds = [given for given in ScriptedEnvironment.given if isinstance(given, int)]
        self.assertEqual(len(seeds), 3)
        self.assertEqual(blocks.terminated.tolist(), [0.0, 0.0], "all its episodes are over")
        ScriptedEnvironment.given = []
        environments.begin_evaluation(10, 0, blocks)
        for _ in range(4):
            self.step(environments, blocks)
        unlimited = [given for given in ScriptedEnvironment.given if isinstance(given, int)]
        self.assertEqual(len(unlimited), 10)
        self.assertEqual(unlimited[:3], seeds, "the same episodes")

    def test_seeds_of_episodes_fit_into_31_bits_and_differ(self) -> None:
        environments, blocks = self.make()
        for episode in range(200):
            environments.begin_training(episode, blocks)
        self.assertEqual(len(set(ScriptedEnvironment.given)), 200)
        self.assertTrue(all(0 <= seed < SEEDS for seed in ScriptedEnvironment.given))

    def test_a_process_draws_alike_at_each_start_and_knows_its_number(self) -> None:
        def drawn(seed: int) -> tuple[float, float]:
            self.make(seed=seed)
            return random.random(), float(np.random.uniform())

        self.assertEqual(drawn(1), drawn(1))
        self.assertNotEqual(drawn(1), drawn(2))
        self.make(count=2)
        self.assertEqual((os.environ["SHOAL_SERVER"], os.environ["SHOAL_ENVIRONMENT"]), ("2", "1"))


if __name__ == "__main__":
    unittest.main()
