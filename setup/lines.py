#!/usr/bin/env python3
"""Counts the product's lines of Rust: without tests and doc comments. Generated code is not in the checkout."""

import collections
import os
import re
import subprocess

TESTS = re.compile(r"(^|/)(tests|benches)/|tests\.rs$")
# An item of tests, with its braces; and a module of tests in a file of its own.
ITEM = re.compile(r"^( *)#\[cfg\(test\)\]\n(?: *#\[.*\n)*[^\n;]*\{\n.*?^\1\}\n", re.M | re.S)
MODULE = re.compile(r"^ *#\[cfg\(test\)\]\n(?: *#\[.*\n)* *(?:pub(?:\(crate\))? )?mod (\w+);", re.M)


def main() -> None:
    paths = [p for p in subprocess.check_output(["git", "ls-files", "*.rs"], text=True).split() if not TESTS.search(p)]
    texts = {}
    for path in filter(os.path.exists, paths):
        with open(path, encoding="utf-8") as file:
            texts[path] = file.read()
    of_tests = set()
    for path, text in texts.items():
        folder, name = os.path.split(path)
        if name not in ("lib.rs", "main.rs", "mod.rs"):
            folder = path[: -len(".rs")]
        of_tests.update("%s/%s.rs" % (folder, module) for module in MODULE.findall(text))
    counts = collections.Counter()
    for path, text in texts.items():
        if path in of_tests:
            continue
        lines = ITEM.sub("", text).splitlines()
        part = "/".join(path.split("/")[: 2 if path.startswith(("crates/", "tests/")) else 1])
        counts[part] += sum(not line.lstrip().startswith(("///", "//!")) for line in lines)
    for part, count in counts.most_common():
        print("%8d  %s" % (count, part))
    print("%8d  lines of the product" % sum(counts.values()))


if __name__ == "__main__":
    main()
