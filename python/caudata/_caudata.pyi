from os import PathLike
from typing import Any, Dict, List, Optional, Tuple

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float32]
_Flags = NDArray[np.bool_]

def preset_names() -> List[str]: ...
def read_log(
    folder: str,
) -> Tuple[str, NDArray[np.float64], Dict[str, NDArray[np.float64]], List[str]]: ...

class Environments:
    shape: Tuple[int, int, int]
    contract: str
    contract_hash: str
    configuration: str
    episode_steps: int
    terms: List[str]
    signals: Dict[str, _Array]
    def __init__(
        self,
        lanes: int,
        seed: int,
        threads: int,
        home: "str | PathLike[str]",
        robot: "str | PathLike[str] | None" = None,
        preset: Optional[str] = None,
        file: Optional[str] = None,
        overrides: List[str] = ...,
        signals: bool = False,
    ) -> None: ...
    def policy_file(self, network: Dict[str, Any], origin: Dict[str, Any]) -> bytes: ...
    def reset(self, observations: _Array, seed: Optional[int] = None) -> None: ...
    def hold_commands(self, commands: _Array, observations: _Array) -> None: ...
    def look(self, observations: _Array) -> None: ...
    def picture(self, lane: int, width: int, height: int) -> NDArray[np.uint8]: ...
    def set_progress(self, env_steps_total: int) -> None: ...
    def step(
        self, actions: _Array, observations: _Array, rewards: _Array, terminated: _Flags, truncated: _Flags
    ) -> Optional[Dict[str, Any]]: ...
