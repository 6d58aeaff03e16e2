"""Environments for rsl_rl."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Dict, Tuple

import torch
from rsl_rl.env import VecEnv as Base
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from . import _policy
from ._environment import VecEnv
from ._torch import activation, dense


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
        self.steps = 0
        """Environment steps so far, over all lanes."""
        self._observations = self._dict(envs.reset()[0])

    def get_observations(self) -> TensorDict:
        return self._observations

    def step(self, actions: torch.Tensor) -> Tuple[TensorDict, torch.Tensor, torch.Tensor, Dict[str, Any]]:
        out = self.envs.step(actions.detach().cpu().numpy())
        observations, rewards, terminated, truncated, infos = out
        self._observations = self._dict(observations)
        self.steps += self.num_envs
        self.envs.set_progress(self.steps)
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


def write_policy(path: "str | os.PathLike[str]", runner: OnPolicyRunner, run_id: str = "rsl_rl") -> Path:
    """Writes the actor of a runner of rsl_rl 5 (``MLPModel``, Gaussian) as :func:`caudata.write_policy` does."""
    if not isinstance(runner.env, RslRlVecEnv):
        raise ValueError("the runner has no environments of caudata")
    actor = runner.alg.get_policy()
    modules = [module for module in actor.mlp.modules() if not list(module.children())]
    normaliser: Dict[str, Any] = {}
    if actor.obs_normalization:
        seen = actor.obs_normalizer
        normaliser = {"obs_mean": seen.mean.cpu().numpy(), "obs_std": (seen.std + seen.eps).cpu().numpy()}
    with torch.no_grad():
        actor(runner.env.get_observations(), stochastic_output=True)
        log_std = actor.output_std[0].log().cpu().numpy()
    return _policy.write_policy(
        path,
        runner.env.envs,
        dense(modules),
        activation=activation(modules),
        log_std=log_std,
        env_steps=runner.env.steps,
        run_id=run_id,
        **normaliser,
    )
