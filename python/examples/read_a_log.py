"""A simulated robot's log as arrays: how far each joint is from its command."""

import sys

import caudata
import numpy as np


def main() -> None:
    log = caudata.read_log(sys.argv[1])
    print("%s, %d rows at %g Hz" % (log.meta["robot"], len(log), log.meta["rate_hz"]))
    commands = log.joints("cmd")
    for joint, position_rad in log.joints("pos").items():
        if joint in commands:
            error_rad = np.sqrt(np.nanmean((position_rad - commands[joint]) ** 2))
            print("%-12s %.4f rad" % (joint, error_rad))


if __name__ == "__main__":
    main()
