"""``python -m caudata.track RUN --to wandb`` (or ``mlflow``): a training in a tracker, while it goes on or afterwards.

``caudata train --logger wandb`` starts it beside a training. It reads what the training writes into its run folder; the
tracker's own package sends it to where that package is set up to. Curves have the names that TensorBoard shows;
settings, policy and evaluation come with them.
"""

from __future__ import annotations

import argparse
import fcntl
import importlib
import json
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, NamedTuple

_FILES = ("config.toml", "changes.toml", "policy.onnx", "evaluation.html", "report.json")
_TRAIN = {"mean_return": "Train/mean_reward", "mean_episode_length": "Train/mean_episode_length"}
_LOOK_EVERY_S = 0.5
_OVER = threading.Event()
"""Nothing more comes: what is there is handed over at once."""


class Tracker(NamedTuple):
    """What a tracker does with the curves of an iteration, with a file, and at the end."""

    curves: Callable[[Dict[str, float], int], None]
    file: Callable[[Path], None]
    end: Callable[[], None]


def wandb(name: str, settings: Dict[str, Any]) -> Tracker:
    """A run of this name in Weights & Biases, as its package is set up."""
    package = importlib.import_module("wandb")
    run = package.init(project="caudata", name=name, config=settings)
    print("tracked at %s" % (run.url or run.dir), flush=True)

    def file(path: Path) -> None:
        run.save(str(path), base_path=str(path.parent), policy="now")

    return Tracker(lambda values, step: run.log(values, step=step), file, run.finish)


def mlflow(name: str, settings: Dict[str, Any]) -> Tracker:
    """A run of this name in MLflow, as its package is set up."""
    package = importlib.import_module("mlflow")
    package.set_experiment("caudata")
    package.start_run(run_name=name)
    print("tracked at %s" % package.get_tracking_uri(), flush=True)
    package.log_params({key: str(value)[:500] for key, value in settings.items()})
    return Tracker(
        lambda values, step: package.log_metrics(values, step=step),
        lambda path: package.log_artifact(str(path)),
        package.end_run,
    )


TRACKERS = {"wandb": wandb, "mlflow": mlflow}


class TrackerFault(Exception):
    """Something that the tracker's own package said."""


def _theirs(call: Callable[..., Any]) -> Callable[..., Any]:
    """The same call of the tracker's package, whose faults are told from those of the run folder."""

    def guarded(*args: Any) -> Any:
        try:
            return call(*args)
        except ModuleNotFoundError:
            raise
        except Exception as error:
            raise TrackerFault("%s: %s" % (type(error).__name__, " ".join(str(error).split()))) from error

    return guarded


def events(run: Path, patience_s: float, until_told: bool = False) -> Iterator[Dict[str, Any]]:
    """The events of a training, those still to come too, until it is over or was silent for too long.

    One that goes on has finished before: only who started it knows when it is over, and says so by SIGTERM
    (``until_told``). Left alone it is over once it has finished; after that there is an evaluation to come. Nothing
    comes where the program that supervised it has ended.
    """
    end = time.monotonic() + patience_s
    finished, said = None, until_told and not _is_left(run)
    with open(run / "progress.jsonl", encoding="utf-8") as file:
        line = ""
        while True:
            last_look = _OVER.is_set()
            line += file.readline()
            if not line.endswith("\n"):  # the rest is still being written, or comes later
                late = time.monotonic() >= end
                left = finished and _is_left(run)
                if last_look or (finished and (late or not until_told and _is_over(run, finished))):
                    return
                if left:  # what it wrote before it ended is read first
                    last_words = file.readline()
                    if not last_words:
                        return
                    line += last_words
                    continue
                if late:
                    raise TimeoutError("nothing came for %g s, and the training has not finished" % patience_s)
                if finished and not said:
                    said = True
                    print("finished; what may still come, its evaluation, is waited for %g s at most" % patience_s, flush=True)
                _OVER.wait(_LOOK_EVERY_S)
                continue
            event, line, end = json.loads(line), "", time.monotonic() + patience_s
            if "event" not in event:
                raise ValueError("a line is no event of a training")
            yield event
            finished = event if event["event"] == "finished" else None


def _is_over(run: Path, finished: Dict[str, Any]) -> bool:
    """Whether nothing comes after this end: the report is there, and not the one of before the training went on."""
    evaluated = _report(run).get("finished", {}).get("policy_sha256") == finished["policy_sha256"]
    return evaluated or finished["reason"] != "completed"


def _is_left(run: Path) -> bool:
    """Whether the program that supervised it has let go of the folder, as it does when it ends."""
    try:
        with open(run / "supervisor.lock", encoding="utf-8") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:  # at work; nobody's: a learner of a cluster; or where files cannot be locked
        return False
    return True


def _report(run: Path) -> Dict[str, Any]:
    report = run / "report.json"
    return json.loads(report.read_text(encoding="utf-8")) if report.exists() else {}


def evaluation(run: Path) -> Dict[str, float]:
    """What the evaluation at the end of a training measured, means over its episodes."""
    found = (_report(run).get("evaluation") or {}).items()
    return {"Evaluation/" + key: value["mean"] for key, value in found if isinstance(value, dict) and "mean" in value}


def curves(event: Dict[str, Any]) -> Dict[str, float]:
    """The curves of an iteration by their names in TensorBoard."""
    out = {"Episode/" + term: value for term, value in event["reward_terms"].items()}
    for key, value in event.items():
        if isinstance(value, (int, float)) and key not in ("iteration", "iterations"):
            out[_TRAIN.get(key, "Caudata/" + key)] = value
    return out


def settings(text: str) -> Dict[str, Any]:
    """The settings of a ``config.toml`` by their keys."""
    try:
        import tomllib
    except ImportError:  # Python 3.10: the file itself is there
        return {}

    def flat(table: Dict[str, Any], before: str) -> Iterator[Any]:
        for key, value in table.items():
            if isinstance(value, dict):
                yield from flat(value, before + key + ".")
            else:
                yield before + key, value

    return dict(flat(tomllib.loads(text), ""))


def track(run: Path, to: str, patience_s: float, until_told: bool = False) -> int:
    """Hands a training over.

    :param to: ``wandb`` or ``mlflow``, whose package is installed
    :param patience_s: the longest wait for the next iteration or the evaluation, s
    :param until_told: only SIGTERM ends it, or patience
    :returns: how many iterations
    :raises TimeoutError: nothing came for that long, and the training had not finished
    :raises ValueError: ``progress.jsonl`` is not of a training
    :raises TrackerFault: what the tracker's package raised
    """
    begin = _theirs(TRACKERS[to])
    begun = begin(run.resolve().name, settings((run / "config.toml").read_text(encoding="utf-8")))
    tracker = Tracker(*map(_theirs, begun))
    count = last = 0
    try:
        for event in events(run, patience_s, until_told):
            if event["event"] == "iteration":
                count, last = count + 1, event["iteration"]
                tracker.curves(curves(event), last)
        if evaluation(run):
            tracker.curves(evaluation(run), last)
        for path in (run / name for name in _FILES):
            if path.exists():
                tracker.file(path)
    finally:
        tracker.end()
    return count


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m caudata.track", description=__doc__)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--to", choices=sorted(TRACKERS), required=True, help="the tracker; its package is installed")
    parser.add_argument("--patience", type=float, default=300.0,
                        help="longest wait for the next iteration or the evaluation, s")  # fmt: skip
    parser.add_argument("--until-told", action="store_true", help="go on after an end until SIGTERM: it may be resumed")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: _OVER.set())
    # Trackers write folders called like their packages, which hide these, or seem to be them.
    sys.path = [folder for folder in sys.path if Path(folder).resolve() != Path.cwd()]
    try:
        count = track(options.run, options.to, options.patience, options.until_told)
        # It may be told so while Python ends, which takes no more signals.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        print("%d iterations are in %s" % (count, options.to))
    except ModuleNotFoundError as missing:
        print("error: %s; `pip install %s`" % (missing, options.to), file=sys.stderr)
        return 69
    except TimeoutError as error:
        print("error: %s: %s" % (options.run, error), file=sys.stderr)
        return 75
    except (OSError, ValueError) as error:
        print("error: %s: %s" % (options.run, error), file=sys.stderr)
        return 66
    except TrackerFault as fault:
        print("error: %s: %s" % (options.to, fault), file=sys.stderr)
        return 69
    return 0


if __name__ == "__main__":
    sys.exit(main())
