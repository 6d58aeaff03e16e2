"""MuJoCo as an engine: lanes of one robot on one ground.

Standard input brings requests, standard output the answers, all little-endian. A request is one letter and what belongs to it; an
answer is K and what was asked for, or E and a text. Texts are a u32 length and UTF-8, numbers f64. SI units, radians.

First come lanes, feet and points of the ground's edge (u32 each; 0 points: a plane), its edge length, and its heights, rows along x
from the smallest x and y. Then:

    M lane (u32), text of an MJCF without ground      the lane's robot from now on
    P lane (u32), positions, velocities, warm start   the lane's state
    S lanes bytes (0: it stands still), then for each lane joint torques, and force and torque on each link at its centre of mass, world
      -> for each lane positions, velocities, warm start; per foot, for the trunk and for the tail: contact force (world), normal force

Joints are called j0, j1, ...; a free base is called base and comes first: position, quaternion; velocity (world), spin (base axes).
Links are called b0, b1, ... Shapes begin with f and the foot's number, t (trunk) or x (tail), then a space.
"""
import struct
import sys

import mujoco
import numpy as np


def read(count):
    data = sys.stdin.buffer.read(count)
    if len(data) < count:
        sys.exit(0)
    return data


def numbers(count):
    return np.frombuffer(read(8 * count), dtype="<f8")


def u32():
    return struct.unpack("<I", read(4))[0]


def text():
    return read(u32()).decode()


class Ground:
    """A plane, or a height field above a plane."""

    DROP_M = 0.002  # of the plane around a field

    def __init__(self):
        self.points = u32()
        (self.size,) = numbers(1)
        self.heights = numbers(self.points**2)

    def add_to(self, spec):
        kinds = mujoco.mjtGeom
        touch = {"contype": 1, "conaffinity": 0, "condim": 3}
        drop = self.DROP_M if self.points else 0.0
        spec.worldbody.add_geom(type=kinds.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, -drop], **touch)
        if not self.points:
            return
        n, half = self.points, self.size / 2
        low, high = float(self.heights.min()), float(self.heights.max())
        rise = max(high - low, 1e-6)
        spec.add_hfield(name="ground", nrow=n, ncol=n, size=[half, half, rise, 0.1], userdata=(self.heights - low) / rise)
        spec.worldbody.add_geom(type=kinds.mjGEOM_HFIELD, hfieldname="ground", pos=[0, 0, low], **touch)


class Robot:
    """What is the same in all lanes with one MJCF."""

    def __init__(self, mjcf, ground, feet):
        self.mjcf = mjcf
        spec = mujoco.MjSpec.from_string(mjcf)
        ground.add_to(spec)
        m = self.m = spec.compile()
        # a lane that breaks down is to be seen, not to begin anew
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        free = m.nq - m.nv  # a quaternion has one number more than a spin
        self.nq, self.nv = m.nq, m.nv
        named = sorted((int(m.joint(i).name[1:]), i) for i in range(free, m.njnt))
        self.q = np.array(list(range(7 * free)) + [m.jnt_qposadr[i] for _, i in named], dtype=int)
        self.v = np.array(list(range(6 * free)) + [m.jnt_dofadr[i] for _, i in named], dtype=int)
        self.torque = self.v[6 * free :]
        self.links = np.array([m.body(f"b{i}").id for i in range(m.nbody - 1)], dtype=int)
        self.part = np.array([self.part_of(m.geom(i).name, feet) for i in range(m.ngeom)])

    @staticmethod
    def part_of(name, feet):
        if not name:
            return -1
        return {"t": feet, "x": feet + 1}.get(name[0]) if name[0] != "f" else int(name[1:].split()[0])


class Lane:
    def __init__(self, robot, parts):
        self.robot = robot
        self.d = mujoco.MjData(robot.m)
        self.contact = np.zeros((parts, 4))

    def place(self, state):
        r, d = self.robot, self.d
        mujoco.mj_resetData(r.m, d)
        d.qpos[r.q] = state[: r.nq]
        d.qvel[r.v] = state[r.nq : r.nq + r.nv]
        d.qacc_warmstart[:] = state[r.nq + r.nv :]
        self.contact[:] = 0

    def step(self, torque, wrench):
        r, d = self.robot, self.d
        d.qfrc_applied[r.torque] = torque
        d.xfrc_applied[r.links] = wrench
        mujoco.mj_step(r.m, d)
        self.contact[:] = 0
        if not d.ncon:
            return
        contact = d.contact
        rows = contact.efc_address
        real = rows >= 0
        # the normal first, along the frame's rows; from the first shape, the ground, to the second
        force = d.efc_force[rows[real][:, None] + np.arange(3)]
        world = np.einsum("ni,nij->nj", force, contact.frame[real].reshape(-1, 3, 3))
        np.add.at(self.contact, r.part[contact.geom[real, 1]], np.column_stack((world, force[:, 0])))

    def state(self):
        r, d = self.robot, self.d
        return [d.qpos[r.q], d.qvel[r.v], d.qacc_warmstart, self.contact.ravel()]


def model(lanes, ground, feet):
    lane, mjcf = u32(), text()
    same = (other.robot for other in lanes if other and other.robot.mjcf == mjcf)
    robot = next(same, None) or Robot(mjcf, ground, feet)
    lanes[lane] = Lane(robot, feet + 2)
    return []


def place(lanes, *_):
    lane = lanes[u32()]
    lane.place(numbers(lane.robot.nq + 2 * lane.robot.nv))
    return []


def step(lanes, *_):
    moves = read(len(lanes))
    answer = []
    for lane, moving in zip(lanes, moves):
        r = lane.robot
        torque, wrench = numbers(len(r.torque)), numbers(6 * len(r.links))
        if moving:
            lane.step(torque, wrench.reshape(-1, 6))
        answer += lane.state()
    return answer


TASKS = {b"M": model, b"P": place, b"S": step}


def main():
    lanes, feet = [None] * u32(), u32()
    ground = Ground()
    out = sys.stdout.buffer
    while True:
        task = TASKS[read(1)]
        try:
            answer = b"K" + b"".join(part.astype("<f8").tobytes() for part in task(lanes, ground, feet))
        except Exception as error:  # the other side reports it in its own words
            reason = f"{type(error).__name__}: {error}".encode()
            answer = b"E" + struct.pack("<I", len(reason)) + reason
        out.write(answer)
        out.flush()


if __name__ == "__main__":
    main()
