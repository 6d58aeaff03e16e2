#!/usr/bin/env python3
"""Builds the documentation as a site that needs no network, into target/site; mkdocs comes from the package index."""

import glob
import os
import shutil
import sys

from common import SetupError, say
from stage import CHECKOUT, TARGET
from wheel import Left, environment, run

TOOLS = ("mkdocs==1.6.1",)
# The pages outside of docs/ that pages link to; README.md is the first page.
OUTSIDE = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md", "docker/README.md", "python/README.md")
CONFIGURATION = """\
site_name: caudata
docs_dir: pages
site_dir: ../site
use_directory_urls: false
theme: {{name: readthedocs, highlightjs: false, include_homepage_in_sidebar: false, locale: en}}
markdown_extensions: [tables, fenced_code]
validation: {{nav: {{omitted_files: ignore}}, links: {{not_found: info, unrecognized_links: info}}}}
nav:
  - caudata: README.md
  - Everything: docs/README.md
  - Where it stands: docs/status.md
  - Guide: [{guide}]
  - Reference: [{reference}]
  - Changes: CHANGELOG.md
  - Map of the code: ARCHITECTURE.md
"""
# Those first that are to be read first.
FIRST = ("tutorial", "first-steps", "your-robot", "your-log", "python")


def pages(folder: str) -> str:
    names = [os.path.basename(path)[:-3] for path in glob.glob(os.path.join(CHECKOUT, "docs", folder, "*.md"))]
    order = sorted(names, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name))
    return ", ".join("docs/%s/%s.md" % (folder, name) for name in order)


def main() -> int:
    work = os.path.join(TARGET, "site-source")
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(os.path.join(CHECKOUT, "docs"), os.path.join(work, "pages", "docs"))
    for page in OUTSIDE:
        copy = os.path.join(work, "pages", page)
        os.makedirs(os.path.dirname(copy), exist_ok=True)
        shutil.copy(os.path.join(CHECKOUT, page), copy)
    configuration = os.path.join(work, "mkdocs.yml")
    with open(configuration, "w", encoding="utf-8") as file:
        file.write(CONFIGURATION.format(guide=pages("guide"), reference=pages("reference")))
    try:
        tools = environment("site-tools", TOOLS)
        run(SetupError, os.path.join(tools, "bin", "mkdocs"), "build", "--quiet", "--config-file", configuration)
    except (Left, SetupError) as error:
        say("error: %s" % error)
        return 1
    say("site: %s" % os.path.relpath(os.path.join(TARGET, "site", "index.html")))
    return 0


if __name__ == "__main__":
    sys.exit(main())
