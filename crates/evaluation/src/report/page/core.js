"use strict";
// Numbers: unpacking tables, rotations, where every link is. No document here, so that any JavaScript engine can test it.
const caudata = {};

// A packed table as rows × columns of 32-bit floats.
caudata.unpack = (packed) => {
  const binary = atob(packed.data);
  const columns = packed.low.length;
  const values = new Float32Array(packed.rows * columns);
  for (let i = 0; i < values.length; i++) {
    const steps = binary.charCodeAt(2 * i) | (binary.charCodeAt(2 * i + 1) << 8);
    const c = i % columns;
    values[i] = packed.low[c] + packed.step[c] * steps;
  }
  return { rows: packed.rows, columns, values, at: (r, c) => values[r * columns + c] };
};

// One column, or a function of every row.
caudata.series = (table, column) => {
  const of = typeof column === "function" ? column : (at) => at(column);
  return Float32Array.from({ length: table.rows }, (_, r) => of((c) => table.at(r, c)));
};

caudata.quatMul = (a, b) => [
  a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
  a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
  a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
  a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
];

caudata.rotate = (q, v) => {
  const [w, x, y, z] = q;
  const tx = 2 * (y * v[2] - z * v[1]), ty = 2 * (z * v[0] - x * v[2]), tz = 2 * (x * v[1] - y * v[0]);
  return [v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx];
};

caudata.add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
caudata.sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

// outer_from_inner composed with a further inner pose.
caudata.compose = (outer, pos, quat) => ({
  pos: caudata.add(outer.pos, caudata.rotate(outer.quat, pos)),
  quat: caudata.quatMul(outer.quat, quat),
});

// The pose of a row of a film: base position, quaternion, joints; between two frames where the row is not whole.
caudata.poseAt = (table, row) => {
  const first = Math.max(0, Math.min(Math.floor(row), table.rows - 1));
  const next = Math.min(first + 1, table.rows - 1);
  const share = Math.max(0, Math.min(row - first, 1));
  const mixed = (c) => table.at(first, c) + share * (table.at(next, c) - table.at(first, c));
  let quat = [3, 4, 5, 6].map((c) => table.at(first, c));
  const other = [3, 4, 5, 6].map((c) => table.at(next, c));
  const dot = quat.reduce((sum, x, i) => sum + x * other[i], 0);
  quat = quat.map((x, i) => x + share * ((dot < 0 ? -1 : 1) * other[i] - x));
  const length = Math.hypot(...quat) || 1;
  const joints = Float64Array.from({ length: table.columns - 7 }, (_, j) => mixed(7 + j));
  return { pos: [mixed(0), mixed(1), mixed(2)], quat: quat.map((x) => x / length), joints };
};

// World pose of every link, by the same rules as the simulator's model: a hinge turns about its anchor, given in the child's frame.
caudata.linkPoses = (robot, pose) => {
  const placed = [];
  for (const link of robot.links) {
    let at = link.parent === null
      ? { pos: pose.pos, quat: pose.quat }
      : caudata.compose(placed[link.parent], link.pos_m, link.quat);
    for (const j of link.joints) {
      const joint = robot.joints[j];
      const value = pose.joints[j];
      if (!joint.hinge) {
        const way = caudata.rotate(at.quat, joint.axis).map((x) => x * value);
        at = { pos: caudata.add(at.pos, way), quat: at.quat };
        continue;
      }
      const anchor = caudata.add(at.pos, caudata.rotate(at.quat, joint.anchor_m));
      const half = value / 2, sin = Math.sin(half);
      const turn = [Math.cos(half), ...joint.axis.map((x) => x * sin)];
      const quat = caudata.quatMul(at.quat, turn);
      at = { pos: caudata.sub(anchor, caudata.rotate(quat, joint.anchor_m)), quat };
    }
    placed.push(at);
  }
  return placed;
};

// First and one past the last index of each run of true values.
caudata.runs = (flags) => {
  const out = [];
  let start = -1;
  for (let i = 0; i <= flags.length; i++) {
    const on = i < flags.length && flags[i];
    if (on && start < 0) start = i;
    if (!on && start >= 0) { out.push([start, i]); start = -1; }
  }
  return out;
};

// What the columns of a table of motion mean, by row.
caudata.openMotion = (motion) => {
  const feet = (motion.columns - 13) / 2;
  return {
    command: (r) => [0, 1, 2].map((c) => motion.at(r, c)),
    achieved: (r) => [3, 4, 5].map((c) => motion.at(r, c)),
    com: (r) => [6, 7, 8].map((c) => motion.at(r, c)),
    heading: (r) => motion.at(r, 9),
    power: (r) => motion.at(r, 10),
    footHeight: (r, f) => motion.at(r, 11 + f),
    footForce: (r, f) => motion.at(r, 11 + feet + f),
    trunkForce: (r) => motion.at(r, 11 + 2 * feet),
    tailForce: (r) => motion.at(r, 12 + 2 * feet),
  };
};

caudata.openGround = ({ water_m, grid }) => ({ water: water_m, grid: grid && { ...grid, heights: caudata.unpack(grid.heights_m).values } });

// A scenario's film, unpacked once.
caudata.openFilm = (film) => {
  if (film.open) return film.open;
  const motion = caudata.unpack(film.motion);
  film.open = {
    period: film.period_s,
    frames: film.pose.rows,
    pose: caudata.unpack(film.pose),
    motion,
    effort: caudata.unpack(film.effort),
    fell: film.fell,
    ...caudata.openGround(film.ground),
    ...caudata.openMotion(motion),
  };
  return film.open;
};

// Height of the ground of an open film, as the simulator interpolates it; 0 where there is no grid.
caudata.groundHeight = (film, x, y) => {
  const g = film.grid;
  if (!g) return 0;
  const rows = g.heights.length / g.columns;
  const gx = Math.max(0, Math.min((x - g.x0_m) / g.cell_m, g.columns - 1.001));
  const gy = Math.max(0, Math.min((y - g.y0_m) / g.cell_m, rows - 1.001));
  const ix = Math.floor(gx), iy = Math.floor(gy), u = gx - ix, v = gy - iy;
  const h = (dx, dy) => g.heights[(iy + dy) * g.columns + ix + dx];
  return u >= v
    ? h(0, 0) + u * (h(1, 0) - h(0, 0)) + v * (h(1, 1) - h(1, 0))
    : h(0, 0) + u * (h(1, 1) - h(0, 1)) + v * (h(0, 1) - h(0, 0));
};

// Largest torque in a direction at a speed in that direction, N·m; against the motion where the speed is negative.
caudata.drivingLimit = (servo, speed) => {
  const slope = (servo.tau_max_nm - servo.tau_there_nm) / (servo.taper_at_radps - servo.flat_to_radps);
  const line = servo.tau_max_nm - slope * (speed - servo.flat_to_radps);
  return Math.max(-servo.tau_brake_max_nm, Math.min(speed < 0 ? servo.tau_brake_max_nm : servo.tau_max_nm, line));
};

// Round steps (1, 2, 5 times a power of ten) inside a range, about `wanted` of them.
caudata.ticks = (low, high, wanted) => {
  const raw = (high - low) / Math.max(1, wanted);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999) || raw;
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push(k * step);
  return out;
};
