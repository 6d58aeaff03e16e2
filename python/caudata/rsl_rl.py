"""Environments for rsl_rl."""

from __future__ import annotations

from typing import Any, Dict, Tuple

import torch
from rsl_rl.env import VecEnv as Base
from tensordict import TensorDict

from ._environment import VecEnv


class RslRlVecEnv(Base):
    """A :class:`caudata.VecEnv` as rsl_rl 3 and later want it: observations under ``policy``."""

    def __init__(self, envs: VecEnv, device: str = "cpu") -> None:
        self.envs = envs
        self.num_envs = envs.num_envs
        self.num_actions = int(envs.single_action_space.shape[0])  # type: ignore[index]
        self.max_episode_length = envs.episode_steps
        self.episode_length_buf = torch.zeros(envs.num_envs, dtype=torch.long, device=device)
        self.device = device
        self.cfg: Dict[str, Any] = envs.contract
        self._observations = self._dict(envs.reset()[0])

    def get_observations(self) -> TensorDict:
        return self._observations

    def step(self, actions: torch.Tensor) -> Tuple[TensorDict, torch.Tensor, torch.Tensor, Dict[str, Any]]:
        out = self.envs.step(actions.detach().cpu().numpy())
        observations, rewards, terminated, truncated, infos = out
        self._observations = self._dict(observations)
        done = torch.from_numpy(terminated | truncated).to(self.device)
        self.episode_length_buf = torch.where(done, 0, self.episode_length_buf + 1)
        extras: Dict[str, Any] = {"time_outs": torch.from_numpy(truncated).to(self.device)}
        if infos:
            lanes = infos["_final_info"]
            sums = infos["final_info"]["terms"][lanes].mean(axis=0)
            extras["log"] = {"/reward/" + name: float(x) for name, x in zip(self.envs.reward_terms, sums) if x != 0.0}
        return self._observations, torch.from_numpy(rewards).to(self.device), done.long(), extras

    def _dict(self, observations: Any) -> TensorDict:
        tensor = torch.from_dlpack(observations).to(self.device)
        return TensorDict({"policy": tensor}, batch_size=[self.num_envs], device=self.device)
