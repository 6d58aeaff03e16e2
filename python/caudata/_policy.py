"""Trained policies."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any, Dict

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
        feed = {"obs": np.ascontiguousarray(observations, np.float32)}
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
