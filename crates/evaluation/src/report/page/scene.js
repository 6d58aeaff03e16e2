// The robot in its scene: camera, ground, water, forces, velocities. What moves it is a film, and the row of it that is shown.

caudata.Scene = class {
  static COLORS = {
    body: [[0.80, 0.56, 0.16], [0.62, 0.42, 0.11]], leg: [0.30, 0.41, 0.52], foot: [0.13, 0.14, 0.16], down: [0.86, 0.17, 0.10],
    ground: [0.66, 0.68, 0.64], water: [0.20, 0.46, 0.60], commanded: [0.16, 0.22, 0.27], achieved: [0.02, 0.52, 0.75], path: [0.93, 0.93, 0.90], force: [0.93, 0.42, 0.30],
  };
  static HOME = { yaw: -2.2, pitch: 0.36, distance: 1.75 };
  static ABOVE = { yaw: Math.PI, pitch: 1.55, distance: 1.9 };
  // Force from which a foot counts as standing, N: the same as in the figures.
  static TOUCH_N = 1;
  // How fast the camera goes after the robot.
  static FOLLOW_PER_S = 7.5;
  // Pictures that take longer than the first, s, are drawn with less detail, and with more where they take less than the second.
  static PICTURE_S = [0.045, 0.019];
  static DETAILS = [1, 0.7, 0.5, 0.35];
  // Vertical field of view, rad.
  static FOV = 0.62;

  constructor(robot, footNames) {
    this.robot = robot;
    this.footNames = footNames;
    this.film = null;
    this.frame = 0;
    this.playing = false;
    this.drawn = 0;
    // mean time of a picture, s, and how many were drawn with the present detail
    this.spent = null;
    this.paced = 0;
    this.camera = { ...caudata.Scene.HOME };
    this.free = [0, 0, 0];
    // links that are drawn in another colour
    this.marked = new Map();
    this.$ = (id) => document.getElementById(id);
    try {
      this.renderer = new caudata.Renderer(this.$("view"));
    } catch (error) {
      this.$("nogl").hidden = false;
      this.$("nogl").textContent = `The robot in three dimensions needs WebGL 2: ${error.message}. Everything below works without it.`;
    }
    const look = (from) => () => { Object.assign(this.camera, from); this.free = [0, 0, 0]; this.dirty = true; };
    this.$("home").onclick = look(caudata.Scene.HOME);
    this.$("above").onclick = look(caudata.Scene.ABOVE);
    this.$("follow").onchange = () => { this.dirty = true; };
    window.addEventListener("resize", () => { this.dirty = true; });
    const { COLORS } = caudata.Scene;
    const dot = (color) => caudata.el("i", { style: `background: rgb(${color.map((x) => Math.round(255 * x)).join(",")})` });
    this.$("legend").append(dot(COLORS.commanded), "commanded", dot(COLORS.achieved), "achieved", dot(COLORS.down), "foot on the ground", dot(COLORS.force), "force, 1 cm/N");
    this.orbit(this.$("view"));
    const again = (now) => {
      this.passed = Math.min((now - (this.last || now)) / 1000, 0.5);
      this.last = now;
      if (this.film) this.tick(this.passed);
      requestAnimationFrame(again);
    };
    requestAnimationFrame(again);
  }

  open(film) {
    if (this.renderer && this.terrain) this.renderer.free(this.terrain);
    this.film = film;
    this.terrain = this.renderer && film && film.grid ? this.renderer.mesh(caudata.meshes.terrain(film.grid)) : null;
    this.target = film && film.frames ? film.com(0) : [0, 0, 0];
    this.base = film && film.frames ? film.heading(0) : 0;
    this.dirty = true;
  }

  // Drag: turn; with shift, the right button or two fingers: move; wheel or pinch: zoom.
  orbit(view) {
    const down = new Map();
    let spread = 0;
    const zoom = (factor) => { this.camera.distance = Math.max(0.35, Math.min(this.camera.distance * factor, 25)); this.dirty = true; };
    const move = (dx, dy) => {
      const k = this.camera.distance * 0.0016, yaw = this.camera.yaw + this.base;
      this.free[0] += k * (dx * Math.sin(yaw) - dy * Math.cos(yaw));
      this.free[1] += k * (-dx * Math.cos(yaw) - dy * Math.sin(yaw));
      this.dirty = true;
    };
    view.addEventListener("contextmenu", (e) => e.preventDefault());
    view.addEventListener("pointerdown", (e) => { view.setPointerCapture(e.pointerId); down.set(e.pointerId, e); spread = 0; });
    for (const end of ["pointerup", "pointercancel"]) view.addEventListener(end, (e) => { down.delete(e.pointerId); spread = 0; });
    view.addEventListener("pointermove", (e) => {
      const before = down.get(e.pointerId);
      if (!before) return;
      const dx = e.clientX - before.clientX, dy = e.clientY - before.clientY;
      down.set(e.pointerId, e);
      if (down.size === 2) {
        const [a, b] = [...down.values()];
        const now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) zoom(spread / now);
        spread = now;
        move(dx / 2, dy / 2);
      } else if (e.shiftKey || e.buttons & 2) {
        move(dx, dy);
      } else {
        this.camera.yaw -= 0.006 * dx;
        this.camera.pitch = Math.max(-0.05, Math.min(this.camera.pitch + 0.006 * dy, 1.55));
        this.dirty = true;
      }
    });
    view.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(0.0012 * e.deltaY)); }, { passive: false });
  }

  // What lies under a point of the screen: the nearest link whose shapes' spheres the line of sight meets, or null, and where
  // that line goes.
  pick(clientX, clientY) {
    const { add, sub, rotate } = caudata;
    const view = this.$("view").getBoundingClientRect();
    const tan = Math.tan(caudata.Scene.FOV / 2), { eye, target, poses } = this.seen;
    const unit = (v) => { const l = Math.hypot(...v) || 1; return v.map((x) => x / l); };
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const ahead = unit(sub(target, eye)), right = unit(cross(ahead, [0, 0, 1])), up = cross(right, ahead);
    const x = ((clientX - view.left) / view.width * 2 - 1) * tan * view.width / view.height, y = (1 - (clientY - view.top) / view.height * 2) * tan;
    const ray = unit(ahead.map((a, i) => a + x * right[i] + y * up[i]));
    let link = null, nearest = Infinity;
    this.robot.links.forEach(({ geoms }, l) => geoms.forEach((geom) => {
      const [a, b = 0, c = 0] = geom.size_m;
      const radius = geom.kind === "capsule" ? a + b : Math.max(a, b, c);
      const to = sub(add(poses[l].pos, rotate(poses[l].quat, geom.pos_m)), eye), along = dot(to, ray);
      const off = Math.sqrt(Math.max(dot(to, to) - along * along, 0));
      // the nearer to the middle of a shape, the more it is meant
      const cost = along + 3 * off;
      if (along > 0 && off < radius + 0.02 && cost < nearest) { nearest = cost; link = l; }
    }));
    return { link, eye, ray };
  }

  // A machine without a graphics processor draws few pixels rather than few pictures.
  pace() {
    if (!this.playing) { this.spent = null; return; }
    this.spent = this.spent === null ? this.passed : 0.95 * this.spent + 0.05 * this.passed;
    this.paced += 1;
    const { DETAILS, PICTURE_S: [slow, fast] } = caudata.Scene, at = DETAILS.indexOf(this.renderer.detail);
    const next = this.spent > slow ? at + 1 : this.spent < fast && this.paced > 600 ? at - 1 : at;
    if (this.paced < 30 || next === at || !DETAILS[next]) return;
    this.renderer.detail = DETAILS[next];
    this.paced = 0;
    this.spent = null;
  }

  // Draws the present row if it has changed.
  tick() {
    if (!this.dirty || !this.renderer) return;
    this.pace();
    this.dirty = this.film.water !== null && this.playing;
    this.draw();
  }

  draw() {
    const { film } = this;
    const row = Math.round(this.frame);
    const poses = caudata.linkPoses(this.robot, caudata.poseAt(film.pose, this.frame));
    if (this.$("follow").checked) {
      const com = film.com(row);
      const k = this.playing ? 1 - Math.exp(-caudata.Scene.FOLLOW_PER_S * this.passed) : 1;
      this.target = this.target.map((x, i) => x + k * (com[i] - x));
    }
    const target = caudata.add(this.target, this.free);
    const { yaw, pitch, distance } = this.camera;
    const turn = yaw + this.base;
    const eye = caudata.add(target, [distance * Math.cos(pitch) * Math.cos(turn), distance * Math.cos(pitch) * Math.sin(turn), distance * Math.sin(pitch)]);
    const lowest = caudata.groundHeight(film, eye[0], eye[1]) + 0.05;
    eye[2] = Math.max(eye[2], lowest);
    this.seen = { eye, target, poses };
    const items = [...this.ground(target), ...this.body(poses, row), ...this.arrows(row), ...this.path(row)];
    if (film.water !== null) items.push({ mesh: this.renderer.unit.plane, pos: [target[0], target[1], film.water], scale: [30, 30, 1], color: caudata.Scene.COLORS.water, alpha: 0.42 });
    this.renderer.draw(items, { eye, target }, film.water, this.frame * film.period);
    this.drawn += 1;
    document.documentElement.dataset.drawn = this.drawn;
    this.hud(row);
  }

  ground(target) {
    const { COLORS } = caudata.Scene;
    const { film } = this;
    const items = [];
    if (this.terrain) items.push({ mesh: this.terrain, color: COLORS.ground, ground: true });
    // the plane without end, and the one under and around every height field
    const z = this.terrain ? -0.01 : 0;
    items.push({ mesh: this.renderer.unit.plane, pos: [target[0], target[1], z], scale: [40, 40, 1], color: COLORS.ground, ground: true });
    return items;
  }

  body(poses, row) {
    const { COLORS, TOUCH_N } = caudata.Scene;
    const { unit } = this.renderer;
    const items = [];
    this.robot.links.forEach((link, l) => {
      const color = this.marked.get(l) || (link.part === "leg" ? COLORS.leg : COLORS.body[link.depth % 2]);
      for (const geom of link.geoms) {
        const { pos, quat } = caudata.compose(poses[l], geom.pos_m, geom.quat);
        const tint = geom.foot === null ? color : this.film.footForce(row, geom.foot) > TOUCH_N ? COLORS.down : COLORS.foot;
        const [a, b, c] = geom.size_m;
        const put = (mesh, scale, at = pos) => items.push({ mesh, pos: at, quat, scale, color: tint });
        if (geom.kind === "sphere") put(unit.sphere, [a, a, a]);
        else if (geom.kind === "ellipsoid") put(unit.sphere, [a, b, c]);
        else if (geom.kind === "box") put(unit.box, [a, b, c]);
        else {
          put(unit.cylinder, [a, a, b]);
          if (geom.kind === "capsule") for (const end of [-b, b]) put(unit.sphere, [a, a, a], caudata.add(pos, caudata.rotate(quat, [0, 0, end])));
        }
      }
    });
    // the force under each foot, 1 cm per newton
    this.robot.feet.forEach((foot, f) => {
      const force = this.film.footForce(row, f);
      if (force <= TOUCH_N) return;
      const at = caudata.add(poses[foot.link].pos, caudata.rotate(poses[foot.link].quat, foot.centre_m));
      const half = Math.min(force, 60) * 0.005;
      items.push({ mesh: unit.cylinder, pos: [at[0], at[1], at[2] + half], scale: [0.0035, 0.0035, half], color: COLORS.force, glow: true });
    });
    return items;
  }

  // Commanded and achieved velocity above the robot, 1 m per m/s.
  arrows(row) {
    const { COLORS } = caudata.Scene;
    const { film } = this;
    const com = film.com(row);
    const near = [];
    for (let r = Math.max(0, row - 17); r <= Math.min(film.frames - 1, row + 17); r++) near.push(film.achieved(r));
    const mean = [0, 1].map((i) => near.reduce((sum, v) => sum + v[i], 0) / near.length);
    const heading = film.heading(row);
    return [[film.command(row), COLORS.commanded, 0.20], [mean, COLORS.achieved, 0.175]].flatMap(([[vx, vy], color, up]) => {
      const length = Math.hypot(vx, vy);
      if (length < 0.01) return [];
      const angle = heading + Math.atan2(vy, vx);
      return this.arrow([com[0], com[1], com[2] + up], angle, length, color);
    });
  }

  arrow(from, angle, length, color) {
    const { unit } = this.renderer;
    // z turned into the horizontal direction
    const lay = [Math.SQRT1_2, 0, Math.SQRT1_2, 0];
    const quat = caudata.quatMul([Math.cos(angle / 2), 0, 0, Math.sin(angle / 2)], lay);
    const head = Math.min(0.07, 0.5 * length), shaft = length - head;
    const at = (s) => [from[0] + s * Math.cos(angle), from[1] + s * Math.sin(angle), from[2]];
    return [
      { mesh: unit.cylinder, pos: at(shaft / 2), quat, scale: [0.006, 0.006, shaft / 2], color, glow: true },
      { mesh: unit.cone, pos: at(shaft + head / 2), quat, scale: [0.017, 0.017, head / 2], color, glow: true },
    ];
  }

  // The way of the centre of mass so far, on the ground or the water.
  path(row) {
    const { film } = this;
    const dots = [];
    for (let r = row - (row % 10); r >= 0 && dots.length < 160; r -= 10) {
      const [x, y] = film.com(r);
      const z = Math.max(caudata.groundHeight(film, x, y), film.water === null ? -Infinity : film.water);
      dots.push({ mesh: this.renderer.unit.dot, pos: [x, y, z + 0.002], scale: [0.006, 0.006, 0.003], color: caudata.Scene.COLORS.path, glow: true });
    }
    return dots;
  }

  hud(row) {
    const { film } = this;
    const wide = (x) => caudata.number(x).padStart(5);
    const show = (v) => `${wide(v[0])} ${wide(v[1])} m/s ${wide(v[2])} rad/s`;
    const touching = this.footNames.filter((_, f) => film.footForce(row, f) > caudata.Scene.TOUCH_N);
    const fell = film.fell && row >= film.frames - 1 ? `\nfell: ${film.fell}` : "";
    this.$("hud").textContent = `commanded ${show(film.command(row))}\nachieved  ${show(film.achieved(row))}\npower ${caudata.number(film.power(row), 1)} W   on the ground: ${touching.join(" ") || "no foot"}${fell}`;
  }
};
