"""Trained policies."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import warnings
from pathlib import Path
from typing import Any, Dict, Optional, Sequence, Tuple

import numpy as np
from numpy.typing import NDArray

from ._data import policy_path
from ._environment import VecEnv

Array = NDArray[np.float32]


class Policy:
    """A policy file, run with ONNX Runtime. Observations go in raw: the normaliser is in the file."""

    def __init__(self, policy: "str | os.PathLike[str]", *, threads: int = 1) -> None:
        """:param policy: name of a policy of the package (:func:`caudata.policies`) or an ONNX file."""
        import onnxruntime

        self.path: Path = policy_path(policy)
        data = self.path.read_bytes()
        self.sha256: str = hashlib.sha256(data).hexdigest()
        """What the file is called by actors, server and robot."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        texts = self._session.get_modelmeta().custom_metadata_map
        if "caudata.policy.v1" not in texts:
            raise ValueError("%s: is no policy of caudata: it lacks the metadata `caudata.policy.v1`" % self.path)
        self.metadata: Dict[str, Any] = json.loads(texts["caudata.policy.v1"])
        """Everything that the file says of itself; ``metadata["contract"]`` says what its numbers mean."""

    def __call__(self, observations: Array) -> Array:
        """Actions ``[N, A]`` for observations ``[N, D]``, without exploration noise."""
        obs = np.ascontiguousarray(observations, np.float32)
        width = self._session.get_inputs()[0].shape[1]
        if obs.ndim != 2 or obs.shape[1] != width:
            raise ValueError(
                "%s takes observations [N, %s], not %s; check(envs) says whether these environments are those of its task"
                % (self.path.name, width, list(obs.shape))
            )
        feed = {"obs": obs}
        return np.asarray(self._session.run(["actions"], feed)[0])

    def check(self, envs: VecEnv) -> None:
        """Refuses environments in which the policy's numbers would mean something else.

        Other ranges of commands and other physical parameters of the same robot are no reason to.
        """
        mine, theirs = self.metadata["contract"], envs.contract
        passed_over = ("robot_hash", "command")
        # A file that is older than a key says nothing of it.
        differing = [key for key in theirs if key not in passed_over and mine.get(key, theirs[key]) != theirs[key]]
        if differing:
            raise ValueError(
                "%s was made for another task: %s differ; make the environments with the preset that it was trained with"
                % (self.path.name, ", ".join(differing))
            )


def write_policy(
    path: "str | os.PathLike[str]",
    envs: VecEnv,
    layers: Sequence[Tuple[Array, Array]],
    *,
    activation: str,
    obs_mean: Optional[Array] = None,
    obs_std: Optional[Array] = None,
    obs_clip: Optional[float] = None,
    log_std: Optional[Array] = None,
    env_steps: int = 0,
    seed: int = 0,
    run_id: str = "python",
) -> Path:
    """Writes a policy that was trained in Python as a file that every program takes: evaluation, page, server, robot.

    It computes ``layers(clip((obs - obs_mean) / obs_std))``. The settings of the environments go into ``config.toml``
    beside it, where the programs look for them. :func:`caudata.sb3.write_policy` and
    :func:`caudata.rsl_rl.write_policy` take all of it from a trained model.

    :param envs: the environments that it was trained in, with the task's own observation.
    :param layers: weight ``[out, in]`` and bias ``[out]`` of each layer, as PyTorch keeps them.
    :param activation: between the layers: ``elu``, ``swish``, ``tanh`` or ``relu``.
    :param obs_mean: ``[D]``; with ``obs_std`` ``[D]`` the normaliser; without them there is none.
    :param obs_clip: where normalised observations are cut off.
    :param log_std: ``[A]``, natural logarithm of the exploration's standard deviation; 0 where it is not said.
    """
    width, actions = envs.task_observation_size, envs.single_action_space.shape[0]  # type: ignore[index]
    if envs.single_observation_space.shape != (width,):
        raise ValueError("a policy file computes the task's observation; these environments have another one")

    def numbers(values: Any) -> Any:
        return np.asarray(values, np.float32).tolist()

    network = {
        "obs_mean": numbers(np.zeros(width) if obs_mean is None else obs_mean),
        "obs_std": numbers(np.ones(width) if obs_std is None else obs_std),
        "obs_clip": obs_clip,
        "activation": activation,
        "layers": [(numbers(weight), numbers(bias)) for weight, bias in layers],
        "log_std": numbers(np.zeros(actions) if log_std is None else log_std),
    }
    try:
        data = envs.policy_file(network, {"run_id": run_id, "env_steps": int(env_steps), "seed": int(seed)})
    except TypeError as wrong:  # pyo3 says which field; the cause says why
        raise ValueError(str(wrong.__cause__ or wrong)) from None
    out = Path(path)
    if out.with_name("run_id.txt").exists():
        raise ValueError("%s is the folder of a training, and config.toml is its own: take another one" % out.parent)
    out.parent.mkdir(parents=True, exist_ok=True)
    config = out.with_name("config.toml")
    other = config.exists() and config.read_text(encoding="utf-8") != envs.configuration
    out.write_bytes(data)
    if other:
        kept = next(p for n in itertools.count(1) if not (p := config.with_name("config.%d.toml" % n)).exists())
        config.rename(kept)
        warnings.warn("%s had other settings; they are in %s now" % (config, kept.name), stacklevel=2)
    config.write_text(envs.configuration, encoding="utf-8")
    return out
