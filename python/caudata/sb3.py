"""Environments for Stable-Baselines3."""

from __future__ import annotations

from typing import Any, List, Optional, Sequence

import numpy as np
from stable_baselines3.common.vec_env import VecEnv as Base

from ._environment import VecEnv


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
