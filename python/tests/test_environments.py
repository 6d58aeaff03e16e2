"""The environments in the forms of gymnasium: what its own checker asks for, and what trainers rely on."""

import unittest
import warnings

import caudata
import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

LANES = 8


def some_actions(envs, steps, seed=0):
    shape = (steps,) + envs.action_space.shape
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def roll(envs, steps=60, seed=None):
    """All that comes out of the environments, as bytes."""
    out = [envs.reset(seed=seed)[0].tobytes()]
    for actions in some_actions(envs, steps):
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        out += [x.tobytes() for x in (observations, rewards, terminated, truncated)]
    return out


class Environments(unittest.TestCase):
    def test_gymnasiums_own_checker_has_nothing_to_say(self):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # No registration, observations without bounds, actions beyond one: all that is allowed.
            warnings.filterwarnings("ignore", message=".*(spec|infinity|symmetric).*")
            check_env(caudata.make("polymander", "quick", render_mode="rgb_array"))

    def test_a_picture_shows_what_moves(self):
        env = caudata.make("quadruped", render_mode="rgb_array")
        env.reset(seed=2)
        before = env.render()
        self.assertEqual((before.shape, before.dtype), ((360, 640, 3), np.uint8))
        np.testing.assert_array_equal(before, env.render())
        for _ in range(10):
            env.step(env.action_space.low)
        after = env.render()
        changed = (before.astype(int) - after).any(axis=2).mean()
        self.assertTrue(0.001 < changed < 0.9, changed)
        envs = caudata.make_vec("quadruped", num_envs=2)
        self.assertEqual(envs.picture(1, width=64, height=48).shape, (48, 64, 3))
        for lane, width in ((2, 64), (0, 3)):
            with self.assertRaises((IndexError, ValueError)):
                envs.picture(lane, width=width)
        self.assertIsNone(caudata.make("quadruped").render())
        with self.assertRaisesRegex(ValueError, "rgb_array"):
            caudata.make("quadruped", render_mode="human")

    def test_it_is_a_vector_environment_of_gymnasium(self):
        envs = caudata.make_vec("polymander", "quick", LANES)
        self.assertIsInstance(envs, gymnasium.vector.VectorEnv)
        self.assertEqual(envs.metadata["autoreset_mode"], gymnasium.vector.AutoresetMode.SAME_STEP)
        observations, infos = envs.reset(seed=3)
        self.assertTrue(envs.observation_space.contains(observations))
        self.assertEqual(infos, {})
        observations, rewards, terminated, truncated, _ = envs.step(envs.action_space.sample())
        self.assertTrue(envs.observation_space.contains(observations))
        for array, dtype in ((rewards, np.float32), (terminated, np.bool_), (truncated, np.bool_)):
            self.assertEqual((array.shape, array.dtype), ((LANES,), dtype))
        recorded = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
        recorded.reset()
        recorded.step(envs.action_space.sample())

    def test_a_seed_repeats_on_any_number_of_threads(self):
        one = roll(caudata.make_vec("polymander", "quick", LANES, seed=5))
        self.assertEqual(one, roll(caudata.make_vec("polymander", "quick", LANES, seed=5, threads=2)))
        other = caudata.make_vec("polymander", "quick", LANES, seed=6)
        self.assertNotEqual(one, roll(other))
        self.assertEqual(one, roll(other, seed=5))

    def test_time_limits_and_falls_are_told_apart(self):
        settings = {"task.episode_steps": 25, "task.stagger_first_episode": False}
        envs = caudata.make_vec("polymander", "quick", LANES, seed=1, settings=settings, copy=False)
        first, _ = envs.reset()
        first, policy = first.copy(), caudata.Policy("flat")
        for step in range(1, 26):
            before = first.copy()
            first, _, terminated, truncated, infos = envs.step(policy(first))
            self.assertFalse(terminated.any())
            self.assertEqual(truncated.all(), step == 25)
        self.assertTrue(infos["_final_obs"].all())
        self.assertEqual(list(infos["final_info"]["episode"]["l"]), [25] * LANES)
        # The last observation goes on from the one before it; the new episode's first does not.
        slices = {s["name"]: slice(s["start"], s["start"] + s["len"]) for s in envs.contract["observation"]["slices"]}
        position = slices["joint_pos_offset"]
        last = np.stack(list(infos["final_obs"]))
        self.assertLess(np.abs(last - before)[:, position].max(), 0.2)
        self.assertTrue((first[:, slices["actions"]] == 0).all())
        self.assertFalse((last[:, slices["actions"]] == 0).all())

    def test_arrays_are_new_or_the_same_as_asked_for(self):
        fresh = caudata.make_vec("polymander", "quick", 2)
        actions = some_actions(fresh, 1)[0]
        self.assertFalse(np.shares_memory(fresh.step(actions)[0], fresh.step(actions)[0]))
        reused = caudata.make_vec("polymander", "quick", 2, copy=False)
        self.assertIs(reused.step(actions)[0], reused.step(actions)[0])
        self.assertEqual(np.from_dlpack(reused.reset()[0]).shape, reused.observation_space.shape)

    def test_signals_are_the_truth_behind_the_observation(self):
        settings = {"task.noise.enabled": False}
        envs = caudata.make_vec("polymander", "quick", LANES, settings=settings, signals=True)
        signals = envs.signals
        self.assertEqual({name for name in signals}, set(caudata.Signals.__annotations__))
        envs.reset(options={"command": (0.25, 0.0, 0.1)})
        joints = signals.joint_pos_rad
        for actions in some_actions(envs, 5):
            observations, _, terminated, truncated, _ = envs.step(actions)
        self.assertIs(joints, signals.joint_pos_rad)
        self.assertFalse((terminated | truncated).any())
        parts = {s["name"]: slice(s["start"], s["start"] + s["len"]) for s in envs.contract["observation"]["slices"]}
        nominal = np.array(envs.contract["nominal_pos_rad"], np.float32)
        np.testing.assert_allclose(observations[:, parts["joint_pos_offset"]], joints - nominal, atol=1e-6)
        np.testing.assert_allclose(observations[:, parts["joint_vel"]], signals.joint_vel_radps, atol=1e-6)
        np.testing.assert_allclose(observations[:, parts["gravity"]], signals.gravity, atol=1e-6)
        np.testing.assert_allclose(signals.command, np.tile(np.float32([0.25, 0.0, 0.1]), (LANES, 1)))
        self.assertEqual(signals.foot_vel_mps.shape, (LANES, 4, 3))
        # Weight on the feet, N: the robot's mass is 2.6 kg.
        self.assertTrue((signals.foot_force_n[..., 2].sum(axis=1) > 0).any())

    def test_rewards_and_observations_of_ones_own(self):
        def reward(signals, actions):
            return signals.com_height_m

        def observation(task, signals):
            return np.concatenate([task, signals.com_height_m[:, None]], axis=1)

        settings = {"task.episode_steps": 10, "task.stagger_first_episode": False}
        envs = caudata.make_vec(
            "polymander", "quick", LANES, settings=settings, reward=reward, observation=observation
        )
        observations, _ = envs.reset()
        start = observations[:, -1].copy()
        self.assertEqual(observations.shape, envs.observation_space.shape)
        for actions in some_actions(envs, 10):
            observations, rewards, _, truncated, infos = envs.step(actions)
        self.assertTrue(truncated.all())
        last = np.stack(list(infos["final_obs"]))
        # The step that ends an episode is rewarded and observed as it was, and the next one as it begins.
        np.testing.assert_array_equal(last[:, -1], rewards)
        self.assertFalse((observations[:, -1] == rewards).any())
        self.assertLess(np.abs(observations[:, -1] - start).max(), 0.05)

    def test_the_task_follows_from_the_robot(self):
        cases = [
            # robot, task, joints, name of the run, forward speed that it is judged at
            (None, None, 16, "quick", 0.3),
            ("quadruped", None, 12, "quadruped", 0.6),
            (None, "biped", 14, "biped", 0.15),
            # `walk` is worked out from the robot that is given
            ("hexapod", "walk", 18, "hexapod", 0.085),
        ]
        for robot, task, joints, name, speed_mps in cases:
            envs = caudata.make_vec(robot, task, 2)
            self.assertEqual(envs.single_action_space.shape, (joints,))
            self.assertIn('name = "%s"' % name, envs.configuration)
            self.assertIn("\ncommand_mps = %s" % speed_mps, envs.configuration)

    def test_what_is_closed_is_not_stepped(self):
        for envs in (caudata.make_vec("polymander", "quick", LANES), caudata.make("polymander", "quick")):
            envs.reset()
            envs.close()
            envs.close()
            for use in (envs.reset, lambda: envs.step(envs.action_space.sample())):
                with self.assertRaisesRegex(gymnasium.error.ClosedEnvironmentError, "are closed: make new ones"):
                    use()

    def test_settings_may_be_numbers_of_numpy(self):
        settings = {"task.episode_steps": np.int64(7), "task.command.vx_mps": np.float32([0.25, 0.5])}
        self.assertEqual(caudata.make_vec(num_envs=1, settings=settings).episode_steps, 7)

    def test_what_is_wrong_is_said_in_one_line(self):
        def one_step(**own):
            envs = caudata.make_vec("polymander", "flat", 2, **own)
            envs.step(np.zeros((2, 16), np.float32))

        cases = [
            (lambda: caudata.make_vec("unicorn"), FileNotFoundError, "unicorn"),
            (lambda: caudata.make_vec("polymander", "sprint.toml"), FileNotFoundError, "sprint.toml"),
            (lambda: caudata.make_vec("polymander", "quik"), FileNotFoundError, "quick, flat"),
            (lambda: one_step(reward=lambda signals, actions: np.ones(3)), ValueError, "shape (3,)"),
            (lambda: one_step(reward=lambda signals, actions: None), ValueError, "no finite number"),
            (lambda: one_step(observation=lambda task, signals: task[0]), ValueError, "[2, K] is wanted"),
            (lambda: caudata.make_vec(num_envs=1).reset(options={"command": (0.3, 0.0)}), ValueError, "yaw rate"),
            (lambda: caudata.make_vec(num_envs=1).reset(options={"command": (0, 0, np.nan)}), ValueError, "finite"),
            (lambda: caudata.make_vec(settings={"task.episode_stepz": 3}), ValueError, "episode_steps"),
            (lambda: caudata.make_vec(num_envs=0), ValueError, "num_envs"),
            (lambda: caudata.make_vec(num_envs=1).step(np.zeros((1, 3), np.float32)), ValueError, "(1, 16) is wanted"),
            (lambda: caudata.make_vec(num_envs=1).step(np.zeros(16, np.float32)), ValueError, "(1, 16) is wanted"),
            (lambda: caudata.make().step(np.zeros((1, 16), np.float32)), ValueError, "(16,) is wanted"),
            (lambda: caudata.make_vec(num_envs=-1), ValueError, "num_envs is a number from 1 on, not -1"),
            (lambda: caudata.make_vec(threads=0), ValueError, "threads is a number from 1 on, not 0"),
            (lambda: caudata.make_vec(num_envs=1).step(np.full((1, 16), np.nan, np.float32)), ValueError, "lane 0"),
            (lambda: caudata.make_vec(num_envs=1).reset(options={"speed": 1}), ValueError, "speed"),
        ]
        for wrong, kind, word in cases:
            with self.assertRaises(kind) as raised:
                wrong()
            self.assertIn(word, str(raised.exception))
            self.assertNotIn("\n", str(raised.exception))


if __name__ == "__main__":
    unittest.main()
