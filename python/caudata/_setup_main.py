"""Provisions libtorch, for `caudata train`: 0.5 GB, once, into ~/.cache/caudata."""

import argparse
import os
import sys

# The modules of the repository's `setup/`, which import each other by their plain names.
HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, HERE)

if __name__ == "__main__":
    from common import SetupError, say
    from provision import libtorch

    argparse.ArgumentParser(prog="python -m caudata.setup", description=__doc__).parse_args()
    try:
        say("libtorch is in %s" % libtorch(verify=False))
    except SetupError as error:
        say("error: %s" % error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        say("interrupted; the next run continues from here")
        sys.exit(130)
