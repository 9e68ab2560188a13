"""Pictures of environments in the file of ``docs/PROTOCOL.md``, drawn without any simulator."""

import json
import os
import tempfile
import unittest
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from shoal_gym.environments import Blocks, Environments
from shoal_gym.pictures import Pictures, scaled, size


class Drawn(gym.Env[Any, Any]):
    """Ends after three steps. Its picture grows red downwards and green to the right; blue is the number of the step, and 100
    more in the second episode."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}
    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    size = (20, 30)

    def __init__(self, render_mode: str | None = None, how: str = "well") -> None:
        self.render_mode, self._how = render_mode, how
        self._episodes = self._steps = 0
        if how == "old" and render_mode is not None:
            raise TypeError("unknown argument render_mode")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._episodes, self._steps = self._episodes + 1, 0
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> Any:
        self._steps += 1
        return np.zeros(3, np.float32), 0.0, self._steps == 3, False, {}

    def render(self) -> Any:
        if self._how == "raises":
            raise RuntimeError("no OpenGL\nhere")
        if self._how == "grey":
            return np.zeros((4, 4), np.uint8)
        if self.render_mode != "rgb_array":
            return None
        rows, columns = Drawn.size
        picture = np.zeros((rows, columns, 3), np.uint8)
        picture[:, :, 0] = np.arange(rows)[:, None]
        picture[:, :, 1] = np.arange(columns)
        picture[:, :, 2] = self._steps + 100 * (self._episodes - 1)
        return picture


gym.register("Drawn-v0", entry_point=Drawn, max_episode_steps=1000)


class Written(unittest.TestCase):
    def setUp(self) -> None:
        Drawn.size = (20, 30)
        place = tempfile.TemporaryDirectory()
        self.addCleanup(place.cleanup)
        self.file = Path(place.name) / "picture"

    def make(self, height: int = 480, **parameters: Any) -> tuple[Environments, Blocks]:
        pictures = Pictures(str(self.file), height)
        environments = Environments("Drawn-v0", parameters, 1, 7, 0, 0, pictures)
        response = np.zeros(Blocks.length(1, 3), np.float32)
        return environments, Blocks.of(response, 1, 3)

    def step(self, environments: Environments, blocks: Blocks) -> None:
        environments.step(environments.action.decode(np.zeros(1, np.float32)), blocks)

    def taken(self) -> tuple[dict[str, Any], NDArray[np.uint8]]:
        line, pixels = self.file.read_bytes().split(b"\n", 1)
        self.file.unlink()
        header = json.loads(line)
        shape = (header["height"], header["width"], 3) if header["kind"] == "rgb" else (0,)
        return header, np.frombuffer(pixels, np.uint8).reshape(shape)

    def test_each_state_is_drawn_the_last_one_too(self) -> None:
        environments, blocks = self.make()
        environments.begin_evaluation(0, 0, blocks)
        for steps in range(4):
            header, picture = self.taken()
            self.assertEqual(header, {"format": 1, "kind": "rgb", "width": 30, "height": 20, "fps": 25})
            self.assertTrue((picture[:, :, 0] == np.arange(20)[:, None]).all())
            self.assertTrue((picture[:, :, 1] == np.arange(30)).all())
            self.assertTrue((picture[:, :, 2] == steps).all(), steps)
            self.step(environments, blocks)
        # The environment has begun its next episode by itself.
        self.assertTrue((self.taken()[1][:, :, 2] == 101).all())

    def test_a_picture_that_nobody_took_stays(self) -> None:
        environments, blocks = self.make()
        environments.begin_evaluation(0, 1, blocks)
        self.step(environments, blocks)
        self.step(environments, blocks)
        self.assertTrue((self.taken()[1][:, :, 2] == 0).all())

    def test_a_reason_is_written_in_the_place_of_a_picture_and_the_episode_goes_on(self) -> None:
        for how, words in [
            ("raises", "RuntimeError: no OpenGL here"),
            ("grey", "an array of uint8 (4, 4)"),
            ("old", "TypeError: unknown argument render_mode"),
        ]:
            environments, blocks = self.make(how=how)
            environments.begin_evaluation(0, 1, blocks)
            for _ in range(2):
                header, picture = self.taken()
                self.assertEqual((header["kind"], picture.size), ("none", 0))
                self.assertIn(words, header["reason"])
                self.step(environments, blocks)
            self.file.unlink()

    def test_a_mode_that_the_user_chose_stays(self) -> None:
        environments, blocks = self.make(render_mode="ansi")
        environments.begin_evaluation(0, 1, blocks)
        self.assertIn("no render_mode rgb_array", self.taken()[0]["reason"])

    def test_large_pictures_become_the_means_of_areas(self) -> None:
        Drawn.size = (100, 250)
        environments, blocks = self.make(height=50)
        environments.begin_evaluation(0, 1, blocks)
        header, picture = self.taken()
        self.assertEqual((header["height"], header["width"]), (40, 100))
        # A pixel covers 2.5 rows and columns.
        expected = np.rint(np.arange(40) * 2.5 + 0.75)
        self.assertLessEqual(np.abs(picture[:, 0, 0] - expected).max(), 1)
        checks = np.array([[0, 255], [255, 0]], np.uint8)[:, :, None].repeat(3, 2)
        self.assertEqual(scaled(checks, 1).tolist(), [[[128] * 3]])

    def test_mujoco_draws_no_more_pixels_than_are_kept(self) -> None:
        self.assertEqual(size("HalfCheetah-v5", 240), {"width": 240, "height": 240})
        self.assertEqual(size("HalfCheetah-v5", 2048), {})
        self.assertEqual(size("Pendulum-v1", 240), {})
        self.assertEqual(size("no_such_module:Nothing-v0", 240), {})

    def test_pictures_are_drawn_only_where_they_are_wanted(self) -> None:
        with patch.dict(os.environ, clear=True):
            self.assertIsNone(Pictures.wanted())
            os.environ["SHOAL_PICTURES"] = str(self.file)
            self.assertIsNotNone(Pictures.wanted())
        environments = Environments("Drawn-v0", {}, 1, 7, 0, 0)
        environments.begin_evaluation(0, 1, Blocks.of(np.zeros(Blocks.length(1, 3), np.float32), 1, 3))
        self.assertFalse(self.file.exists())
