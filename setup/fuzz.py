#!/usr/bin/env python3
"""Knocks at every door that bytes come in by (tests/fuzz), led by the branches of the code that earlier inputs
reached: builds the doors with LLVM's SanitizerCoverage and libFuzzer, and tells what was reached.

What reached something new lies in target/fuzz/corpus. `--keep` takes small inputs that reach what smaller ones do not into
tests/fuzz/corpus, which `make test` tries as well.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from typing import Dict, List, Tuple

from common import SetupError, machine, say
from stage import CHECKOUT

HERE = os.path.join(CHECKOUT, "target", "fuzz")
COVERAGE = (
    "--cfg=fuzzing -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4"
    " -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table"
    " -Cllvm-args=-sanitizer-coverage-trace-compares -Ccodegen-units=4 -Copt-level=2 -Cstrip=none"
)


def main() -> int:
    parser = argparse.ArgumentParser(prog="setup/fuzz.py", description=__doc__.split("\n\n")[0])
    parser.add_argument("door", nargs="*", help="doors to knock at (all)")
    parser.add_argument("--seconds", type=int, default=60, help="how long at each (60)")
    parser.add_argument("--keep", action="store_true", help="keep what it found in tests/fuzz/corpus")
    options = parser.parse_args()
    try:
        program = build()
        doors = listed(program)
        for name in set(options.door) - set(doors):
            raise SetupError("there is no door %s, only %s" % (name, " ".join(doors)))
        print("%-24s %12s %9s %10s %18s" % ("door", "inputs", "corpus", "functions", "branches of these"))
        left: Dict[str, Tuple[int, int]] = {}
        for door in options.door or doors:
            knock(program, door, options.seconds, options.keep, left)
        print("\nfunctions with the most branches that nothing reached (what only a panic would take is among them):")
        for name, (reached, total) in sorted(left.items(), key=lambda x: x[1][0] - x[1][1])[:15]:
            print("  %4d of %4d  %s" % (reached, total, name))
    except SetupError as error:
        say("error: %s" % error)
        return error.exit_code
    return 0


def build() -> str:
    target = "%s-unknown-linux-gnu" % machine()
    command = ["cargo", "test", "--release", "--locked", "-p", "caudata-fuzz", "--test", "doors", "--no-run"]
    # with --target the flags are for what is tried, and not for what builds it
    command += ["--target", target, "--message-format", "json-render-diagnostics"]
    env = dict(os.environ, RUSTFLAGS=COVERAGE, CARGO_TARGET_DIR=HERE)
    done = subprocess.run(command, cwd=CHECKOUT, env=env, stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        raise SetupError("the doors do not build")
    made = [json.loads(line) for line in done.stdout.splitlines()]
    return [m["executable"] for m in made if m.get("target", {}).get("name") == "doors" and m.get("executable")][-1]


def listed(program: str) -> List[str]:
    lines = subprocess.run([program, "--list", "--format", "terse"], stdout=subprocess.PIPE, check=True).stdout
    return [line.split(":")[0] for line in lines.decode().splitlines() if line.endswith(": test")]


def knock(program: str, door: str, seconds: int, keep: bool, left: Dict[str, Tuple[int, int]]) -> None:
    corpus = os.path.join(HERE, "corpus")
    flags = "-max_total_time=%d -max_len=65536 -timeout=20 -rss_limit_mb=2048 -artifact_prefix=%s/" % (seconds, HERE)
    told = run(program, door, corpus, flags + " -verbosity=0 -print_final_stats=1")
    inputs = re.search(r"number_of_executed_units: *(\d+)", told)
    rows = [line.split("\t")[1:] for line in run(program, door, corpus, "", keep).splitlines() if line.startswith("reached\t")]
    counts = {name: (int(reached), int(total)) for reached, total, name in rows}
    for name, both in counts.items():
        left[name] = max(left.get(name, (0, 0)), both)
    reached, total = (sum(c[k] for c in counts.values()) for k in (0, 1))
    size = len(os.listdir(os.path.join(corpus, door)))
    row = (door, inputs.group(1) if inputs else "?", size, len(counts), "%d of %d" % (reached, total))
    print("%-24s %12s %9d %10d %18s" % row, flush=True)


def run(program: str, door: str, corpus: str, flags: str, keep: bool = False) -> str:
    env = dict(os.environ, CAUDATA_FUZZ_CORPUS=corpus, CAUDATA_FUZZ_FLAGS=flags)
    if keep:
        env["CAUDATA_FUZZ_KEEP"] = "1"
    command = [program, "--exact", door, "--nocapture", "--test-threads", "1"]
    cwd = os.path.join(CHECKOUT, "tests", "fuzz")
    done = subprocess.run(command, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    told = done.stdout.decode("utf-8", "replace")
    if done.returncode != 0:
        raise SetupError("%s: an input broke a rule:\n%s" % (door, "\n".join(told.splitlines()[-30:])))
    return told


if __name__ == "__main__":
    sys.exit(main())
