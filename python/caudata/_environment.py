"""Environments in the forms of gymnasium."""

from __future__ import annotations

import json
import os
from typing import Any, Callable, Dict, Mapping, Optional, Tuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from ._caudata import Environments
from ._data import HOME, presets, robot_path
from ._signals import Signals

Array = NDArray[np.float32]
RewardFunction = Callable[[Signals, Array], Array]
"""Signals and actions ``[N, A]`` to rewards ``[N]``."""
ObservationFunction = Callable[[Array, Signals], Array]
"""The task's observations ``[N, D]`` and signals to other observations ``[N, K]``."""

_SEED_MAX = 2**63 - 1
_COUNT_MAX = 2**32 - 1


class VecEnv(gymnasium.vector.VectorEnv[Array, Array, NDArray[Any]]):
    """``N`` environments of one task, stepped together in compiled code.

    An episode that ends is followed by the next one in the same step (``AutoresetMode.SAME_STEP``): the observation is
    then the first of the new episode, and ``infos["final_obs"][lane]`` the last of the old one. The same seed gives the
    same episodes on any number of threads.

    Use :func:`make_vec` to make one.
    """

    metadata: Dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(
        self,
        core: Environments,
        *,
        seed: int,
        reward: Optional[RewardFunction] = None,
        observation: Optional[ObservationFunction] = None,
        signals: bool = False,
        copy: bool = True,
    ) -> None:
        self._core = core
        self._reward, self._observe, self._copy = reward, observation, copy
        self.num_envs, self._width, actions = core.shape
        self.signals: Optional[Signals] = Signals(core.signals) if signals else None
        """The true state, where it is read (``signals=True``, or a reward or observation of your own)."""
        self.contract: Dict[str, Any] = json.loads(core.contract)
        """What a policy for these environments must be made for: joints, gains, layout of the observation."""
        self.contract_hash: str = core.contract_hash
        self.episode_steps: int = core.episode_steps
        """Control steps until an episode is truncated."""
        self.reward_terms: Tuple[str, ...] = tuple(core.terms)
        """Names of the task's reward terms, in the order of ``infos["final_info"]["terms"]``."""
        self._buffers = self._allocate()
        self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random(seed)
        clip = float(self.contract["action"]["clip"])
        core.look(self._buffers[0])
        width = self._observed(self._buffers[0]).shape[1]
        box = gymnasium.spaces.Box
        self.single_observation_space = box(-np.inf, np.inf, (width,), np.float32)
        self.single_action_space = box(-clip, clip, (actions,), np.float32)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, self.num_envs)
        self.action_space = batch(self.single_action_space, self.num_envs)

    @property
    def configuration(self) -> str:
        """Every setting in effect, as the TOML that ``--config`` and ``task=`` take."""
        return self._core.configuration

    @property
    def task_observation_size(self) -> int:
        """D of the task's own observation."""
        return self._width

    def policy_file(self, network: Dict[str, Any], origin: Dict[str, Any]) -> bytes:
        """For :func:`caudata.write_policy`."""
        return self._core.policy_file(network, origin)

    @property
    def control_period_s(self) -> float:
        """Time between two actions, s."""
        return float(self.contract["control_period_s"])

    def reset(
        self, *, seed: Optional[int] = None, options: Optional[Dict[str, Any]] = None
    ) -> Tuple[Array, Dict[str, Any]]:
        """Starts a new episode in every lane. With a seed the episodes are those that the seed begins with.

        ``options={"command": (vx_mps, vy_mps, yaw_rate_radps)}`` makes every lane follow that command from now on,
        instead of commands that are drawn; ``[N, 3]`` gives each lane its own.
        """
        self._must_be_open()
        super().reset(seed=seed)
        options = dict(options or {})
        command = options.pop("command", None)
        if options:
            raise ValueError("unknown option '%s'; known is: command" % next(iter(options)))
        observations = self._arrays()[0]
        self._core.reset(observations, None if seed is None else int(seed) & _SEED_MAX)
        if command is not None:
            commands = np.asarray(command, np.float32)
            if commands.shape not in ((3,), (self.num_envs, 3)):
                wanted = "a command is vx, vy (m/s) and yaw rate (rad/s), or [N, 3] of them"
                raise ValueError("%s; not of shape %s" % (wanted, commands.shape))
            if not np.isfinite(commands).all():
                raise ValueError("a command is finite; not %s" % (command,))
            commands = np.broadcast_to(commands, (self.num_envs, 3))
            self._core.hold_commands(np.ascontiguousarray(commands), observations)
        return self._observed(observations), {}

    def step(
        self, actions: Array
    ) -> Tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], Dict[str, Any]]:
        """One control step of all lanes. ``actions`` ``[N, A]``; the task clips them to its action space."""
        self._must_be_open()
        actions = np.ascontiguousarray(actions, np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError("actions of shape %s; %s is wanted" % (actions.shape, self.action_space.shape))
        observations, rewards, terminated, truncated = self._arrays()
        ended = self._core.step(actions, observations, rewards, terminated, truncated)
        if self._reward is not None:
            assert self.signals is not None
            own = np.asarray(self._reward(self.signals, actions), np.float32)
            fits = own.shape in ((), rewards.shape)
            if not fits or not np.isfinite(own).all():
                what = "what is no finite number" if fits else "shape %s" % (own.shape,)
                raise ValueError("reward= gives %s; a number for each of the %d lanes is wanted" % (what, self.num_envs))
            rewards[:] = own
        infos = {} if ended is None else self._infos(ended, observations)
        return self._observed(observations), rewards, terminated, truncated, infos

    def picture(self, lane: int = 0, width: int = 640, height: int = 360) -> NDArray[np.uint8]:
        """The robot of a lane as it is now, RGB, ``[height, width, 3]``; of a lane whose episode ended, the next one's
        start."""
        self._must_be_open()
        return self._core.picture(lane, width, height)

    def set_progress(self, env_steps_total: int) -> None:
        """Tells how many environment steps were trained for in all; pushes and costs of some presets grow with it."""
        self._core.set_progress(env_steps_total)

    def _must_be_open(self) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("these environments are closed: make new ones")

    def _observed(self, observations: Array) -> Array:
        if self._observe is None:
            return observations
        assert self.signals is not None
        own = np.asarray(self._observe(observations, self.signals), np.float32)
        if own.ndim != 2 or own.shape[0] != self.num_envs:
            raise ValueError("observation= gives shape %s; [%d, K] is wanted" % (own.shape, self.num_envs))
        return own

    def _infos(self, ended: Dict[str, Any], observations: Array) -> Dict[str, Any]:
        lanes = ended["lane"]
        final = ended["final_observation"]
        if self._observe is not None:
            last = observations.copy()
            last[lanes] = final
            final = self._observed(last)[lanes].copy()
            self._core.look(observations)
        mask = np.zeros(self.num_envs, np.bool_)
        mask[lanes] = True
        final_obs = np.full(self.num_envs, None, dtype=object)
        for lane, row in zip(lanes, final):
            final_obs[lane] = row

        def spread(values: NDArray[Any]) -> NDArray[Any]:
            out = np.zeros((self.num_envs, *values.shape[1:]), values.dtype)
            out[lanes] = values
            return out

        info: Dict[str, Any] = {
            name: spread(values) for name, values in ended.items() if name not in ("lane", "final_observation")
        }
        info["episode"] = {"r": info.pop("return"), "l": info.pop("steps"), "_r": mask, "_l": mask}
        info.update({"_" + name: mask for name in list(info)})
        return {"final_obs": final_obs, "_final_obs": mask, "final_info": info, "_final_info": mask}

    def _allocate(self) -> Tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        lanes = self.num_envs
        flags = (np.empty(lanes, np.bool_), np.empty(lanes, np.bool_))
        return (np.empty((lanes, self._width), np.float32), np.empty(lanes, np.float32), *flags)

    def _arrays(self) -> Tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        return self._allocate() if self._copy else self._buffers


def make_vec(
    robot: "str | os.PathLike[str] | None" = None,
    task: "str | os.PathLike[str] | None" = None,
    num_envs: int = 128,
    *,
    seed: int = 0,
    threads: int = 1,
    settings: Optional[Mapping[str, Any]] = None,
    reward: Optional[RewardFunction] = None,
    observation: Optional[ObservationFunction] = None,
    signals: bool = False,
    copy: bool = True,
) -> VecEnv:
    """``num_envs`` environments of a task on a robot.

    :param robot: name of a robot of the package (:func:`caudata.robots`), or a ``*.robot.toml`` file; without one, the
        robot of the task.
    :param task: name of a preset (:func:`caudata.presets`), or a TOML file of settings; without one, the preset that
        is made for the robot, else ``walk``, which works for any.
    :param threads: processor threads that step the lanes; results do not depend on it.
    :param settings: single settings by their key, for instance ``{"task.episode_steps": 500}``;
        ``caudata config show`` lists them.
    :param reward: rewards of your own instead of the task's, of signals and actions.
    :param observation: observations of your own instead of the task's, of the task's observations and signals.
    :param signals: whether to fill :attr:`VecEnv.signals` after every step.
    :param copy: with ``False`` every step writes into the same arrays instead of new ones.
    """
    for name, count in (("num_envs", num_envs), ("threads", threads)):
        if not 1 <= count <= _COUNT_MAX:
            raise ValueError("%s is a number from 1 on, not %s" % (name, count))
    signals = signals or reward is not None or observation is not None
    named = task is not None and str(task) in presets()
    if task is not None and not named and not os.path.isfile(task):
        known = ", ".join(presets())
        raise FileNotFoundError("there is no task '%s': give a preset (%s) or a TOML file of settings" % (task, known))
    overrides = ["%s=%s" % (key, _toml(value)) for key, value in (settings or {}).items()]
    core = Environments(
        num_envs,
        int(seed) & _SEED_MAX,
        threads,
        home=HOME,
        robot=None if robot is None else robot_path(robot),
        preset=str(task) if named else None,
        file=None if named or task is None else os.fspath(task),
        overrides=overrides,
        signals=signals,
    )
    return VecEnv(core, seed=seed, reward=reward, observation=observation, signals=signals, copy=copy)


class Env(gymnasium.Env[Array, Array]):
    """One environment, for what takes only one. Use :func:`make` to make one; :func:`make_vec` is much faster."""

    metadata: Dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(self, lanes: VecEnv, render_mode: Optional[str] = None) -> None:
        if lanes.num_envs != 1:
            raise ValueError("one environment is wanted, not %d" % lanes.num_envs)
        if render_mode not in (None, "rgb_array"):
            raise ValueError("render_mode is 'rgb_array' or None, not %r" % render_mode)
        self.lanes = lanes
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / lanes.control_period_s)}
        self.observation_space = lanes.single_observation_space
        self.action_space = lanes.single_action_space

    def reset(
        self, *, seed: Optional[int] = None, options: Optional[Dict[str, Any]] = None
    ) -> Tuple[Array, Dict[str, Any]]:
        """As :meth:`VecEnv.reset`."""
        super().reset(seed=seed)
        observations, infos = self.lanes.reset(seed=seed, options=options)
        return observations[0], infos

    def step(self, action: Array) -> Tuple[Array, float, bool, bool, Dict[str, Any]]:
        """One control step; the observation of an episode that ends is its last."""
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError("an action of shape %s; %s is wanted" % (action.shape, self.action_space.shape))
        out = self.lanes.step(action[None])
        observations, rewards, terminated, truncated, infos = out
        ended = bool(terminated[0] or truncated[0])
        observation = infos["final_obs"][0] if ended else observations[0]
        info: Dict[str, Any] = {}
        if ended:
            episode = infos["final_info"]["episode"]
            info["episode"] = {"r": float(episode["r"][0]), "l": int(episode["l"][0])}
        return observation, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> Optional[NDArray[np.uint8]]:  # type: ignore[override]
        """With ``render_mode="rgb_array"`` the robot as it is now (:meth:`VecEnv.picture`)."""
        return self.lanes.picture() if self.render_mode else None

    def close(self) -> None:
        """As :meth:`VecEnv.close`."""
        self.lanes.close()


def make(
    robot: "str | os.PathLike[str] | None" = None,
    task: "str | os.PathLike[str] | None" = None,
    *,
    render_mode: Optional[str] = None,
    **options: Any,
) -> Env:
    """One environment; with ``render_mode="rgb_array"`` it draws. The other options are those of :func:`make_vec`."""
    return Env(make_vec(robot, task, 1, **options), render_mode)


def _toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, (list, tuple, np.ndarray)):
        return "[%s]" % ", ".join(_toml(entry) for entry in value)
    raise TypeError("a setting is a number, a word, a truth value or a list of these, not %r" % (value,))
