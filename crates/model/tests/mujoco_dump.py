"""Prints what MuJoCo makes of an MJCF file in given configurations, one record per line.

Usage: mujoco_dump.py FILE.xml < configurations, one line each: base x y z, quaternion w x y z, then name=position ...
A last word `drop SECONDS` instead simulates with the named positions as position commands and prints the end state.
Called by tests/mujoco.rs.
"""

import sys

import mujoco
import numpy as np


def numbers(values):
    return " ".join(repr(float(x)) for x in np.asarray(values).flatten())


def pose(model, data, words):
    mujoco.mj_resetData(model, data)
    data.qpos[:7] = [float(w) for w in words[:7]]
    for word in words[7:]:
        name, value = word.split("=")
        data.joint(name).qpos[0] = float(value)
        if name in {model.actuator(i).name for i in range(model.nu)}:
            data.actuator(name).ctrl[0] = float(value)
    mujoco.mj_forward(model, data)


def dump(model, data):
    print("mass", numbers(sum(model.body_mass)))
    for i in range(1, model.nbody):
        print("body", model.body(i).name, numbers(data.xpos[i]), numbers(data.xmat[i]))
    for i in range(1, model.njnt):
        print("joint", model.joint(i).name, numbers(data.xanchor[i]), numbers(data.xaxis[i]))
    for i in range(model.nsite):
        print("site", model.site(i).name, numbers(data.site_xpos[i]), numbers(data.site_xmat[i]))
    row = np.zeros(model.nv)
    for i in range(model.nv):
        unit = np.zeros(model.nv)
        unit[i] = 1.0
        mujoco.mj_mulM(model, data, row, unit)
        print("inertia", i, numbers(row))


def drop(model, data, seconds):
    feet = {model.geom(n + "_foot").id for n in ("FL", "FR", "HL", "HR")}
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    touching = sorted({model.geom(int(g)).name for c in data.contact[: data.ncon] for g in c.geom})
    print("touching", *touching)
    print("feet_in_contact", len(feet & {int(g) for c in data.contact[: data.ncon] for g in c.geom}))
    print("base", numbers(data.qpos[:7]))
    print("speed", numbers(np.abs(data.qvel).max()))


model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
print("version", mujoco.__version__)
print("nv", model.nv)
for line in sys.stdin:
    words = line.split()
    seconds = None
    if words[-2] == "drop":
        seconds = float(words[-1])
        words = words[:-2]
    pose(model, data, words)
    print("configuration")
    if seconds is None:
        dump(model, data)
    else:
        drop(model, data, seconds)
