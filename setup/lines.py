#!/usr/bin/env python3
"""Counts the product's lines of Rust: without tests and doc comments. Generated code is not in the checkout."""

import collections
import re
import subprocess

TESTS = re.compile(r"(^|/)(tests|benches)/(?!hidden_effects/(?:src|examples)/|chaos_proxy/src|left_out/src)|tests\.rs$")
FIRST = re.compile(r"^( *)#\[cfg\(test\)\]\n *(?:pub )?mod \w+ \{\n.*?^\1\}\n", re.M | re.S)


def main() -> None:
    counts = collections.Counter()
    for path in subprocess.check_output(["git", "ls-files", "*.rs"], text=True).split():
        if TESTS.search(path):
            continue
        with open(path, encoding="utf-8") as file:
            lines = FIRST.sub("", file.read()).splitlines()
        part = "/".join(path.split("/")[: 2 if path.startswith(("crates/", "tests/")) else 1])
        counts[part] += sum(not line.lstrip().startswith(("///", "//!")) for line in lines)
    for part, count in counts.most_common():
        print("%8d  %s" % (count, part))
    print("%8d  lines of the product" % sum(counts.values()))


if __name__ == "__main__":
    main()
