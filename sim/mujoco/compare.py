"""MuJoCo as the other side of `caudata sim verify` and `caudata bench sim`.

Reads one JSON request per line on standard input, answers each with one JSON line. The MJCF is the robot's own, unchanged; what it
lacks or the robot file decides (friction, armature, springs, servo) comes with the request. SI units, radians.

The servo is not one of MuJoCo's actuators: these know no torque-speed line. At every step this script works out
tau = clamp(kp (target - q) - kd qd) with the same envelope as the engines, and applies it as a joint force over that step.
Where the envelope does not matter (`speed`), MuJoCo's position actuators of the MJCF are used, so that no Python runs between steps.
"""
import json
import sys
import time

import mujoco
import mujoco.rollout
import numpy as np


def build(req):
    """The model of a request: `mjcf`, `fixed_base`, `joints` (per name), `options`, `terrain`."""
    spec = mujoco.MjSpec.from_string(req["mjcf"])
    if req.get("fixed_base"):
        for joint in list(spec.joints):
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                spec.delete(joint)
    terrain = req.get("terrain")
    if terrain:
        n = terrain["points"]
        heights = np.asarray(terrain["heights_m"], dtype=float)
        top = max(float(heights.max()), 1e-6)
        half = terrain["size_m"] / 2
        spec.add_hfield(name="ground", nrow=n, ncol=n, size=[half, half, top, 0.1], userdata=heights / top)
        for geom in list(spec.geoms):
            if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
                spec.delete(geom)
        spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground")
    m = spec.compile()
    options = req["options"]
    m.opt.timestep = options["dt_s"]
    m.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if options["cone"] == "elliptic" else mujoco.mjtCone.mjCONE_PYRAMIDAL
    m.opt.impratio = options.get("impratio", 1.0)
    m.opt.iterations = options.get("iterations", 100)
    m.opt.ls_iterations = options.get("ls_iterations", 50)
    m.opt.density = options.get("density", 0.0)
    m.opt.viscosity = options.get("viscosity", 0.0)
    if "gravity_mps2" in options:
        m.opt.gravity[:] = options["gravity_mps2"]
    for name, p in req["joints"].items():
        joint = m.joint(name)
        dof = joint.dofadr[0]
        m.dof_damping[dof] = p["damping"]
        m.dof_armature[dof] = p["armature"]
        m.dof_frictionloss[dof] = p["friction"]
        m.jnt_stiffness[joint.id] = p["stiffness"]
        m.qpos_spring[joint.qposadr[0]] = p["spring_ref"]
    # what the compiler derived from armature and friction is derived anew; the reference pose stays as it is
    mujoco.mj_setConst(m, mujoco.MjData(m))
    return m


def addresses(m, names):
    q = [int(m.joint(n).qposadr[0]) for n in names]
    v = [int(m.joint(n).dofadr[0]) for n in names]
    return q, v


def place(m, d, req, q_addresses, joint_pos, base):
    d.qpos[q_addresses] = joint_pos
    if not req.get("fixed_base") and m.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        d.qpos[:7] = base


def accelerations(req):
    """Accelerations without contact, stops or dry friction, for given states and joint torques."""
    m = build(req)
    off = mujoco.mjtDisableBit
    m.opt.disableflags |= off.mjDSBL_CONTACT | off.mjDSBL_LIMIT | off.mjDSBL_FRICTIONLOSS | off.mjDSBL_ACTUATION
    d = mujoco.MjData(m)
    q, v = addresses(m, req["joint_names"])
    free = m.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    answer = []
    for s in req["states"]:
        place(m, d, req, q, s["joint_pos"], s["base"])
        d.qvel[v] = s["joint_vel"]
        if free:
            d.qvel[:6] = s["base_vel"]
        d.qfrc_applied[:] = 0
        d.qfrc_applied[v] = s["joint_torque"]
        mujoco.mj_forward(m, d)
        base = d.qacc[:6].tolist() if free else []
        answer.append({"base": base, "joints": d.qacc[v].tolist()})
    return answer


class Servo:
    """The position loop behind its envelope, all joints at once."""

    def __init__(self, p):
        get = lambda key: np.array([s[key] for s in p], dtype=float)
        self.kp, self.kd = get("kp"), get("kd")
        self.flat, self.stall, self.taper = get("tau_max"), get("stall"), get("taper")
        self.brake = get("tau_brake_max")

    def torque(self, target, q, qd):
        tau = self.kp * (target - q) - self.kd * qd
        up = np.minimum(np.where(qd < 0, self.brake, self.flat), self.stall - self.taper * qd)
        down = np.minimum(np.where(qd > 0, self.brake, self.flat), self.stall + self.taper * qd)
        return np.clip(tau, np.minimum(-down, self.brake), np.maximum(up, -self.brake))


def gaits(req):
    """Open-loop runs: `runs` of target rows held for `control_period_s` each. Answers with the path of each."""
    m = build(req)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    d = mujoco.MjData(m)
    q, v = addresses(m, req["actuated"])
    all_q, _ = addresses(m, req["joint_names"])
    servo = Servo(req["servos"])
    substeps = round(req["control_period_s"] / m.opt.timestep)
    answer = []
    # a robot without such sites has no heading
    sites = req["heading_sites"]
    hind, front = (m.site(n).id for n in sites) if sites else (0, 0)
    for run in req["runs"]:
        mujoco.mj_resetData(m, d)
        place(m, d, req, all_q, run["joint_pos"], run["base"])
        mujoco.mj_forward(m, d)
        path = []

        def report():
            mujoco.mj_kinematics(m, d)
            mujoco.mj_comPos(m, d)
            if not sites:
                line = (1.0, 0.0)
            elif hind == front:  # the x axis of one site
                line = d.site_xmat[hind].reshape(3, 3)[:, 0]
            else:
                line = d.site_xpos[front] - d.site_xpos[hind]
            path.append(d.subtree_com[0].tolist() + [float(np.arctan2(line[1], line[0]))] + d.qpos[:3].tolist())

        report()
        for row in run["targets"]:
            target = np.asarray(row)
            for _ in range(substeps):
                d.qfrc_applied[v] = servo.torque(target, d.qpos[q], d.qvel[v])
                mujoco.mj_step(m, d)
            report()
        answer.append(path)
    return answer


SPEED = {}


def speed(req):
    """Steps per second of mujoco.rollout on one thread: `start` prepares, `round` measures for about `seconds`."""
    if "mjcf" in req:
        m = build(req)
        d = mujoco.MjData(m)
        q, _ = addresses(m, req["joint_names"])
        place(m, d, req, q, req["joint_pos"], req["base"])
        # the MJCF's actuators stand in policy order
        control = np.asarray(req["targets"])
        rows = np.repeat(control, req["substeps"], axis=0)
        state = np.zeros(mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(m, d, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        SPEED[req["name"]] = (m, d, state, rows[None], mujoco.rollout.Rollout(nthread=0))
        return "ready"
    m, d, state, control, rollout = SPEED[req["name"]]
    steps, began = 0, time.perf_counter()
    while steps == 0 or time.perf_counter() - began < req["seconds"]:
        rollout.rollout(m, d, state[None], control)
        steps += control.shape[1]
    return {"steps": steps, "seconds": time.perf_counter() - began}


TASKS = {"accelerations": accelerations, "gaits": gaits, "speed": speed}


def main():
    for line in sys.stdin:
        req = json.loads(line)
        try:
            answer = {"ok": TASKS[req["task"]](req)}
        except Exception as error:  # the other side reports it in its own words
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
