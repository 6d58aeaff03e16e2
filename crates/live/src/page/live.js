// The live page: what the server sends, put where it is seen.

caudata.Live = class extends caudata.Scene {
  // Rows that are kept: 40 s, more than any picture looks back.
  static ROWS = 2048;
  // How far the picture is behind the newest step, rows: what late steps are waited for.
  static BEHIND = 2;
  static WEAK = 0.3;
  static MARKS = { weak: [0.62, 0.35, 0.75], limp: [0.85, 0.20, 0.56] };
  static PUSH_SHOWN_MS = 400;

  constructor(about, give) {
    super(about.robot, about.foot_names);
    this.about = about;
    this.give = give;
    this.playing = true;
    this.trace = new caudata.Trace();
    this.drive = new caudata.Drive(about.ranges, give);
    this.strengths = about.joint_names.map(() => 1);
    this.mode = "push";
    this.chips = about.joint_names.map((name, i) => caudata.el("button", { type: "button", onclick: () => this.weaken(i) }, name));
    this.$("joints").replaceChildren(...this.chips);
    this.$("terrain").replaceChildren(...about.terrains.map((kind) => caudata.el("option", { value: kind }, kind.replaceAll("_", " "))));
    this.$("terrain").onchange = () => give({ do: "terrain", kind: this.$("terrain").value });
    for (const mode of ["push", "joint"]) this.$(`mode-${mode}`).onclick = () => this.choose(mode);
    this.clicks(this.$("view"));
  }

  choose(mode) {
    this.mode = mode;
    for (const each of ["push", "joint"]) this.$(`mode-${each}`).setAttribute("aria-checked", each === mode);
  }

  // Another ground, or the same: the robot is at its start.
  begin({ kind, period_s, ground }) {
    const { ROWS } = caudata.Live;
    const columns = 7 + this.robot.joints.length, all = columns + 13 + 2 * this.footNames.length;
    const ring = new Float32Array(ROWS * all);
    const at = (r, c) => ring[(r % ROWS) * all + c];
    const film = { period: period_s, frames: 0, fell: null, ...caudata.openGround(ground), ...caudata.openMotion({ columns: all - columns, at: (r, c) => at(r, columns + c) }) };
    film.pose = { columns, at, get rows() { return film.frames; } };
    film.add = (row) => { ring.set(row, (film.frames % ROWS) * all); film.frames += 1; };
    this.$("terrain").value = kind;
    this.open(film);
    this.head = 0;
  }

  step(row) {
    if (!this.film) return;
    this.film.add(row);
    if (this.film.frames === 1) { this.target = this.film.com(0); this.base = this.film.heading(0); }
    document.documentElement.dataset.frames = this.film.frames;
  }

  // The picture runs at its own speed and is led to where it belongs.
  tick(passed) {
    const { film } = this;
    if (!film.frames) return;
    const newest = film.frames - 1, wanted = newest - caudata.Live.BEHIND;
    this.head += passed / film.period;
    const off = wanted - this.head;
    this.head = Math.abs(off) > 25 ? wanted : this.head + 0.06 * off;
    const frame = Math.max(0, Math.min(this.head, newest));
    this.dirty = this.dirty || frame !== this.frame;
    this.frame = frame;
    this.drive.pad();
    this.trace.draw(film, performance.now());
    super.tick();
  }

  // A click that is no drag.
  clicks(view) {
    let from = null;
    view.addEventListener("pointerdown", (e) => { from = from ? { lost: true } : { x: e.clientX, y: e.clientY, at: performance.now() }; });
    view.addEventListener("pointerup", (e) => {
      const began = from;
      from = null;
      if (!began || began.lost || !this.seen || e.button > 0) return;
      if (Math.hypot(e.clientX - began.x, e.clientY - began.y) > 6 || performance.now() - began.at > 500) return;
      const picked = this.pick(e.clientX, e.clientY);
      this.mode === "push" ? this.push(picked) : this.weakenLink(picked.link);
    });
    view.addEventListener("pointercancel", () => { from = null; });
  }

  // On the robot: away from the camera. Beside it: from there.
  push({ link, eye, ray }) {
    const com = this.film.com(Math.round(this.frame));
    let way = [ray[0], ray[1]];
    if (link === null && ray[2] < -0.02) {
      const far = (com[2] - eye[2]) / ray[2];
      way = [com[0] - eye[0] - far * ray[0], com[1] - eye[1] - far * ray[1]];
    }
    const length = Math.hypot(...way);
    if (length < 1e-6) return;
    const size = Number(this.$("push-size").value);
    const velocity_mps = way.map((w) => w / length * size);
    this.pushed = { angle: Math.atan2(way[1], way[0]), size, until: performance.now() + caudata.Live.PUSH_SHOWN_MS };
    this.give({ do: "push", velocity_mps });
  }

  arrows(row) {
    const items = super.arrows(row), push = this.pushed;
    if (push && performance.now() < push.until) {
      const [x, y, z] = this.film.com(row), length = 0.15 + 0.2 * push.size;
      items.push(...this.arrow([x - length * Math.cos(push.angle), y - length * Math.sin(push.angle), z], push.angle, length, caudata.Scene.COLORS.down));
    }
    return items;
  }

  weakenLink(link) {
    const joint = link === null ? -1 : this.robot.actuated.findIndex((j) => this.robot.links[link].joints.includes(j));
    if (joint >= 0) this.weaken(joint);
  }

  // Whole, weak, limp, whole.
  weaken(index) {
    const now = this.strengths[index];
    this.give({ do: "joint", index, strength: now === 1 ? caudata.Live.WEAK : now > 0 ? 0 : 1 });
  }

  told({ velocity, strengths }) {
    this.drive.told(velocity);
    this.strengths = strengths;
    this.marked.clear();
    strengths.forEach((strength, i) => {
      const state = strength === 1 ? "" : strength > 0 ? "weak" : "limp";
      this.chips[i].className = state;
      this.chips[i].textContent = this.about.joint_names[i] + (state && `: ${state}`);
      const link = this.robot.links.findIndex((l) => l.joints.includes(this.robot.actuated[i]));
      if (state && link >= 0) this.marked.set(link, caudata.Live.MARKS[state]);
    });
    this.dirty = true;
  }
};

caudata.start = () => {
  const root = document.documentElement, $ = (id) => document.getElementById(id);
  root.dataset.errors = "0";
  window.addEventListener("error", (e) => { root.dataset.errors = Number(root.dataset.errors) + 1; root.dataset.error = e.message; });
  const token = new URLSearchParams(location.search).get("token") || "";
  const note = (text) => { $("note").textContent = text; };
  const state = (text, kind) => { $("state").textContent = text; $("dot").className = `dot ${kind}`; };
  const orders = new caudata.Orders(token, note);
  const training = new caudata.Training();
  const beside = new caudata.Beside(token, (curve) => training.beside(curve));
  const settings = new caudata.Settings(token, new URLSearchParams(location.search).get("change") || "");
  let live = null, source = null;

  const policy = (about) => {
    const million = (n) => `${(n / 1e6).toFixed(1)} million steps`;
    $("policy").textContent = about ? ` · policy ${about.version} · ${million(about.env_steps)} · ${about.sha256.slice(0, 12)}` : " · no policy: it holds its pose";
  };
  const on = {
    robot: (about) => { if (!live) live = new caudata.Live(about, (order) => orders.give(order)); $("name").textContent = about.name; caudata.live = live; },
    ground: (ground) => live.begin(ground),
    told: (told) => live.told(told),
    policy, note,
    history: (points) => training.restore(points),
    training: (point) => training.add(point),
    settings: (now) => { settings.show(now); training.mark(now.made); beside.list(); },
  };
  const open = () => {
    if (source || document.hidden) return;
    source = new EventSource(`events?token=${encodeURIComponent(token)}`);
    source.onopen = () => { state("live", "good"); root.dataset.ready = "true"; };
    source.onmessage = (e) => { if (live) live.step(JSON.parse(e.data)); };
    for (const [name, take] of Object.entries(on)) source.addEventListener(name, (e) => take(JSON.parse(e.data)));
    source.onerror = () => {
      const refused = source.readyState === EventSource.CLOSED;
      state(refused ? "refused: too many pages look already, or the program has ended" : "no connection; trying again", "bad");
      if (refused) { source = null; setTimeout(open, 3000); }
    };
  };
  const close = () => { if (source) source.close(); source = null; };
  document.addEventListener("visibilitychange", () => { if (document.hidden) { close(); state("paused while nobody looks", ""); } else open(); });
  window.addEventListener("pagehide", close);
  open();
};

if (typeof document !== "undefined") caudata.start();
