"""Environments for Stable-Baselines3."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

import numpy as np
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv as Base
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_wrapper

from . import _policy
from ._environment import VecEnv
from ._torch import activation, dense



class SB3VecEnv(Base):
    """A :class:`caudata.VecEnv` as Stable-Baselines3 wants it, with the returns of episodes for its monitor."""

    def __init__(self, envs: VecEnv) -> None:
        self.envs = envs
        self._actions: Optional[np.ndarray] = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        # Stable-Baselines3 gives each environment a seed of its own, counting up from the first.
        observations, _ = self.envs.reset(seed=self._seeds[0], options=self._options[0])
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        out: List[dict] = [{} for _ in range(self.num_envs)]
        for lane in np.flatnonzero(terminated | truncated):
            episode = infos["final_info"]["episode"]
            out[lane] = {
                "terminal_observation": infos["final_obs"][lane],
                "TimeLimit.truncated": bool(truncated[lane]),
                "episode": {"r": float(episode["r"][lane]), "l": int(episode["l"][lane]), "t": 0.0},
            }
        return observations, rewards, terminated | truncated, out

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> List[Any]:
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> List[Any]:
        return [getattr(self.envs, method_name)(*args, **kwargs)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Sequence[bool]:
        return [False] * len(list(self._get_indices(indices)))


def write_policy(path: "str | os.PathLike[str]", model: OnPolicyAlgorithm, run_id: str = "sb3") -> Path:
    """Writes the policy of PPO or A2C with ``MlpPolicy`` as :func:`caudata.write_policy` does, its ``VecNormalize`` too.

    The model's environments are to be those that it was trained in.
    """
    base = model.get_env()
    envs = None if base is None else base.unwrapped
    if not isinstance(envs, SB3VecEnv):
        raise ValueError("the model has no environments of caudata: set_env(SB3VecEnv(envs)) gives it some")
    policy = model.policy
    modules = [*policy.mlp_extractor.policy_net, policy.action_net]
    normaliser: Dict[str, Any] = {}
    wrapper = unwrap_vec_wrapper(base, VecNormalize)
    if wrapper is not None and wrapper.norm_obs:
        seen = wrapper.obs_rms
        std = np.sqrt(seen.var + wrapper.epsilon)
        normaliser = {"obs_mean": seen.mean, "obs_std": std, "obs_clip": float(wrapper.clip_obs)}
    return _policy.write_policy(
        path,
        envs.envs,
        dense(modules),
        activation=activation(modules),
        log_std=policy.log_std.detach().cpu().numpy(),
        env_steps=model.num_timesteps,
        seed=model.seed or 0,
        run_id=run_id,
        **normaliser,
    )
