// The diagrams of an evaluation. Those over time share one cursor with the replay; a click or drag there seeks.

caudata.Plots = class {
  static WINDOW_S = 8;

  // `seek` takes a frame.
  constructor(page, seek) {
    this.page = page;
    this.seek = seek;
    this.sheets = {};
    for (const name of ["track", "gait", "body", "wave", "legs", "servo", "path"]) this.sheets[name] = new caudata.Sheet(document.getElementById(`plot-${name}`));
    this.axes = {};
    for (const name of ["track", "gait", "body", "legs"]) this.seekable(name);
    const redraw = () => { this.drawn = {}; this.all(); };
    window.addEventListener("resize", redraw);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  }

  seekable(name) {
    const canvas = this.sheets[name].canvas;
    let down = false;
    const go = (e) => {
      const axes = this.axes[name];
      if (!axes || !this.film) return;
      const [l, , r] = axes.box;
      const x = Math.max(l, Math.min(e.clientX - canvas.getBoundingClientRect().left, r));
      this.seek(Math.round((axes.x[0] + (x - l) / (r - l) * (axes.x[1] - axes.x[0])) / this.film.period));
    };
    canvas.style.cursor = "pointer";
    canvas.addEventListener("pointerdown", (e) => { down = true; canvas.setPointerCapture(e.pointerId); go(e); });
    // the windows move with the cursor: dragging there would run away
    canvas.addEventListener("pointermove", (e) => { if (down && name === "track") go(e); });
    canvas.addEventListener("pointerup", () => { down = false; });
  }

  open(index, film) {
    this.scenario = this.page.result.scenarios[index];
    this.shown = this.page.shown[index];
    this.film = film;
    this.frame = 0;
    this.drawn = {};
    this.shore = !!this.scenario.transition;
    if (film) this.times = Float32Array.from({ length: film.frames }, (_, r) => r * film.period);
    this.captions();
    this.all();
  }

  all() {
    if (!this.scenario) return;
    this.track(); this.gait(); this.body(); this.wave(); this.legs(); this.servo(); this.path();
  }

  // `soon`: the frame is one of many in a row, a few of which may be left out.
  at(frame, soon) {
    this.frame = frame;
    const now = performance.now();
    if (soon && now - (this.last || 0) < 45) return;
    this.last = now;
    this.track(); this.gait(); this.body(); this.legs(); this.path();
  }

  captions() {
    const set = (name, title, text) => {
      const cap = document.getElementById(`cap-${name}`);
      cap.replaceChildren(caudata.el("b", {}, title), ` ${text}`);
    };
    const several = this.shown.grid.length > 0;
    set("track", "Velocity tracking.", several ? "Commanded against achieved, one dot per command, mean over its episodes." : "Means over 0.7 s of each episode; band: from the tenth to the ninetieth percentile over episodes. Click to seek.");
    set("gait", "Gait.", "Bars: on the ground. Eight seconds around the cursor.");
    set("body", "Spine and tail.", "Yaw joints from head (top) to tail; a wave to the tail leans to the right going down.");
    set("wave", "The wave along the body.", "How far each yaw joint lags behind the first at the common frequency, and how far it swings, over all episodes.");
    set("legs", "Legs.", this.shore ? "Hip and knee of each leg over the whole episode; shaded: the foot is on the ground; blue: the centre of mass is over water." : "Hip (solid) and knee (dashed) of each leg around the cursor; shaded: the foot is on the ground.");
    set("servo", "Torque and speed of every servo", `in the episode shown, as shares of its own largest torque and speed without load, against its envelope at ${this.page.servos[0].supply_v} V.`);
    set("path", "Seen from above.", "Way of the centre of mass in the episode shown, 1 s between dots.");
  }

  get time() { return this.frame * this.film.period; }

  window() {
    const length = this.film.frames * this.film.period, half = caudata.Plots.WINDOW_S / 2;
    const start = Math.max(0, Math.min(this.time - half, length - 2 * half));
    return [start, Math.min(start + 2 * half, Math.max(length, 0.1))];
  }

  // Frames inside a window, one more on each side.
  inside([from, to]) {
    const first = Math.max(0, Math.floor(from / this.film.period) - 1);
    return [first, Math.min(this.film.frames, Math.ceil(to / this.film.period) + 2)];
  }

  track() {
    const sheet = this.sheets.track;
    if (this.shown.grid.length) {
      if (!this.drawn.track) this.grid();
      this.drawn.track = true;
      return undefined;
    }
    const { curves } = this.shown;
    if (!curves) return sheet.empty("no episodes to show");
    // everything but the cursor is drawn once
    if (!this.drawn.track) {
      sheet.begin();
      const { theme, width, height } = sheet;
      const names = ["forward, m/s", "to the left, m/s", "yaw rate, rad/s"];
      const n = curves.signals[0].mean.length, xs = Float32Array.from({ length: n }, (_, k) => k * curves.step_s);
      const top = 22, gap = 14, each = (height - top - 42 - 2 * gap) / 3;
      this.trackAxes = curves.signals.map((s, i) => {
        const y0 = top + i * (each + gap);
        const axes = sheet.axes({ box: [62, y0, width - 10, y0 + each], x: [0, Math.max(xs[n - 1], 0.1)], y: caudata.range([s.command, s.low, s.high, s.mean], 0.1), xTicks: 10, yTicks: 4, xText: i === 2, xLabel: i === 2 ? "time, s" : "" });
        sheet.band(axes, xs, s.low, s.high, theme.band);
        sheet.line(axes, xs, s.command, theme.command, 1.5, [5, 4]);
        sheet.line(axes, xs, s.mean, theme.accent, 2);
        sheet.text(names[i], width - 16, y0 + 11, { align: "right", color: theme.soft });
        return axes;
      });
      sheet.key([{ label: "commanded", color: theme.command, dash: [5, 4] }, { label: "achieved, mean", color: theme.accent }, { label: "10 to 90 %", color: theme.band, band: true }], 62, 9);
      this.axes.track = this.trackAxes[0];
      this.drawn.track = true;
      sheet.keep();
    } else {
      sheet.restore();
    }
    if (this.film) this.trackAxes.forEach((axes) => sheet.cursor(axes, this.time));
  }

  grid() {
    const sheet = this.sheets.track.begin();
    const { theme, width, height, ctx } = sheet;
    const names = ["forward, m/s", "to the left, m/s", "yaw rate, rad/s"];
    const each = (width - 30) / 3;
    this.axes.track = null;
    names.forEach((name, i) => {
      const points = this.shown.grid.map((row) => [row[i], row[3 + i]]);
      const range = caudata.range([points.flat()], 0.1);
      const l = 10 + i * each + 52;
      const axes = sheet.axes({ box: [l, 12, l + each - 66, height - 42], x: range, y: range, xTicks: 4, yTicks: 5, xLabel: `commanded ${name}`, yLabel: i === 0 ? "achieved" : "" });
      sheet.line(axes, range, range, theme.command, 1, [5, 4]);
      sheet.clip(axes, () => {
        ctx.fillStyle = theme.accent; ctx.globalAlpha = 0.65;
        for (const [x, y] of points) { ctx.beginPath(); ctx.arc(axes.px(x), axes.py(y), 3, 0, 7); ctx.fill(); }
      });
    });
  }

  bars(sheet, axes, flags, first, y, half, color) {
    const { ctx } = sheet, { period } = this.film;
    sheet.clip(axes, () => {
      ctx.fillStyle = color;
      for (const [a, b] of caudata.runs(flags)) {
        const x0 = axes.px((first + a - 0.5) * period), x1 = axes.px((first + b - 0.5) * period);
        ctx.fillRect(x0, y - half, Math.max(x1 - x0, 1), 2 * half);
      }
    });
  }

  gait() {
    const sheet = this.sheets.gait;
    if (!this.film) return sheet.empty("no film of this scenario");
    sheet.begin();
    const { theme, width, height } = sheet, { film } = this, TOUCH = caudata.Scene.TOUCH_N;
    const x = this.window(), [first, last] = this.inside(x);
    const axes = sheet.axes({ box: [62, 6, width - 10, height - 36], x, y: [0, 1], xTicks: 8, yTicks: 0, xLabel: "time, s" });
    this.axes.gait = axes;
    const touching = (force) => Array.from({ length: last - first }, (_, i) => force(first + i) > TOUCH);
    const rows = [...this.page.foot_names.map((name, f) => [name, (r) => film.footForce(r, f), theme.feet[f % theme.feet.length]]), ["trunk", (r) => film.trunkForce(r), theme.bad], ["tail", (r) => film.tailForce(r), theme.soft]];
    const step = (height - 42) / rows.length;
    rows.forEach(([name, force, color], i) => {
      const y = 6 + (i + 0.5) * step;
      sheet.text(name, 54, y, { align: "right", color: theme.soft });
      this.bars(sheet, axes, touching(force), first, y, 0.36 * step, color);
    });
    sheet.cursor(axes, this.time);
  }

  body() {
    const sheet = this.sheets.body;
    if (!this.film) return sheet.empty("no film of this scenario");
    sheet.begin();
    const { theme, width, height, ctx } = sheet, { film } = this, { robot, joint_names } = this.page;
    const whole = this.window(), half = (whole[1] - whole[0]) / 4, middle = Math.max(whole[0] + half, Math.min(this.time, whole[1] - half));
    const x = [middle - half, middle + half], [first, last] = this.inside(x);
    const axes = sheet.axes({ box: [62, 6, width - 10, height - 36], x, y: [-7.8, 0.8], xTicks: 5, yTicks: 0, xLabel: "time, s" });
    this.axes.body = axes;
    const columns = Array.from({ length: 8 }, (_, j) => 7 + robot.actuated[j]);
    let most = 0.05;
    for (let r = 0; r < film.frames; r += 3) for (const c of columns) most = Math.max(most, Math.abs(film.pose.at(r, c)));
    columns.forEach((c, j) => {
      const xs = [], ys = [];
      for (let r = first; r < last; r++) { xs.push(r * film.period); ys.push(-j + 0.6 * film.pose.at(r, c) / most); }
      ctx.strokeStyle = theme.faint;
      ctx.beginPath(); ctx.moveTo(axes.box[0], axes.py(-j)); ctx.lineTo(axes.box[2], axes.py(-j)); ctx.stroke();
      sheet.line(axes, xs, ys, theme.chain[j], 1.8);
      sheet.text(joint_names[j].replace("_", " "), 56, axes.py(-j), { align: "right", color: theme.soft });
    });
    const scale = most * 180 / Math.PI;
    sheet.text(`distance of two lines: ${caudata.number(scale / 0.6, 0)}°`, 62, height - 17, { base: "top", color: theme.soft });
    sheet.cursor(axes, this.time);
  }

  wave() {
    const sheet = this.sheets.wave;
    const t = this.scenario.transition;
    const waves = t ? [["on land", t.wave_on_land], ["in water", t.wave_in_water]] : [["", this.scenario.wave]];
    const there = waves.filter(([, wave]) => wave);
    if (!there.length) return sheet.empty("the body hardly bends here");
    sheet.begin();
    const { theme, width, height, ctx } = sheet, deg = 180 / Math.PI;
    const colors = t ? [theme.feet[1], theme.accent] : [theme.accent];
    const lags = there.map(([, w]) => w.lag_rad.map((x) => x * deg)), swings = there.map(([, w]) => w.amplitude_rad.map((x) => x * deg));
    const xs = [1, 2, 3, 4, 5, 6, 7, 8], middle = (height - 60) * 0.6 + 22;
    const upper = sheet.axes({ box: [62, 24, width - 10, middle], x: [0.7, 8.3], y: caudata.range([...lags, [0]], 30), xTicks: 8, yTicks: 4, xText: false, yLabel: "lag, °" });
    const lower = sheet.axes({ box: [62, middle + 14, width - 10, height - 36], x: [0.7, 8.3], y: [0, Math.max(...swings.flat(), 1) * 1.1], xTicks: 8, yTicks: 2, yLabel: "swing, °", xLabel: "yaw joint, head to tail" });
    const entries = [];
    waves.forEach(([name, wave], i) => {
      if (!wave) return;
      const k = there.findIndex(([, w]) => w === wave);
      for (const [axes, ys] of [[upper, lags[k]], [lower, swings[k]]]) {
        sheet.line(axes, xs, ys, colors[i], 2);
        sheet.clip(axes, () => { ctx.fillStyle = colors[i]; ys.forEach((y, j) => { ctx.beginPath(); ctx.arc(axes.px(j + 1), axes.py(y), 3.2, 0, 7); ctx.fill(); }); });
      }
      entries.push({ label: `${name} ${caudata.number(wave.hz.mean)} Hz, ${wave.travels_to_the_tail ? "travels to the tail" : "does not travel to the tail"}`.trim(), color: colors[i] });
    });
    sheet.key(entries, 62, 11);
  }

  legs() {
    const sheet = this.sheets.legs;
    if (!this.film) return sheet.empty("no film of this scenario");
    sheet.begin();
    const { theme, width, height, ctx } = sheet, { film } = this, { robot, foot_names } = this.page;
    const x = this.shore ? [0, film.frames * film.period] : this.window(), [first, last] = this.inside(x);
    const each = (height - 60) / 4, deg = 180 / Math.PI, TOUCH = caudata.Scene.TOUCH_N;
    foot_names.forEach((name, f) => {
      const hip = 7 + robot.actuated[8 + 2 * f], knee = 7 + robot.actuated[9 + 2 * f];
      const top = 22 + f * each;
      const xs = [], hips = [], knees = [], touch = [];
      for (let r = first; r < last; r++) { xs.push(r * film.period); hips.push(film.pose.at(r, hip) * deg); knees.push(film.pose.at(r, knee) * deg); touch.push(film.footForce(r, f) > TOUCH); }
      const axes = sheet.axes({ box: [62, top, width - 10, top + each - 8], x, y: [-80, 110], xTicks: 8, yTicks: 2, yText: true, xText: f === 3, xLabel: f === 3 ? "time, s" : "", yLabel: `${name}, °` });
      if (film.water !== null) this.bars(sheet, axes, this.overWater(first, last), first, top + (each - 8) / 2, (each - 8) / 2, theme.water);
      ctx.globalAlpha = 0.22;
      this.bars(sheet, axes, touch, first, top + (each - 8) / 2, (each - 8) / 2, theme.feet[f % theme.feet.length]);
      ctx.globalAlpha = 1;
      sheet.line(axes, xs, hips, theme.feet[f % theme.feet.length], 1.6);
      sheet.line(axes, xs, knees, theme.feet[f % theme.feet.length], 1.3, [4, 3]);
      sheet.cursor(axes, this.time);
      this.axes.legs = axes;
    });
    sheet.key([{ label: "hip, forward positive", color: theme.soft }, { label: "knee, down positive", color: theme.soft, dash: [4, 3] }], 62, 10);
  }

  overWater(first, last) {
    const { film } = this;
    return Array.from({ length: last - first }, (_, i) => {
      const [x, y] = film.com(first + i);
      return caudata.groundHeight(film, x, y) < film.water;
    });
  }

  servo() {
    const sheet = this.sheets.servo;
    if (!this.film) return sheet.empty("no film of this scenario");
    sheet.begin();
    const { theme, width, height, ctx } = sheet, { servos, in_leg: inLeg } = this.page, { effort } = this.film;
    const joints = effort.columns / 2;
    const speed = (r, j) => effort.at(r, joints + j) / servos[j].taper_at_radps;
    const torque = (r, j) => effort.at(r, j) / servos[j].tau_max_nm;
    let fastest = 1.12;
    for (let r = 0; r < effort.rows; r++) for (let j = 0; j < joints; j++) fastest = Math.max(fastest, Math.abs(speed(r, j)) * 1.05);
    const most = 1.1 * Math.max(1, ...servos.map((servo) => servo.tau_brake_max_nm / servo.tau_max_nm));
    const axes = sheet.axes({ box: [62, 24, width - 10, height - 36], x: [-fastest, fastest], y: [-most, most], xTicks: 7, yTicks: 5, xLabel: "speed / speed without load", yLabel: "torque / largest torque" });
    sheet.clip(axes, () => {
      ctx.globalAlpha = 0.28;
      for (let j = 0; j < joints; j++) {
        ctx.fillStyle = inLeg[j] ? theme.accent : theme.feet[1];
        for (let r = 0; r < effort.rows; r++) ctx.fillRect(axes.px(speed(r, j)) - 1, axes.py(torque(r, j)) - 1, 2, 2);
      }
      ctx.globalAlpha = 1;
    });
    const speeds = Array.from({ length: 121 }, (_, i) => (i - 60) / 60 * fastest);
    const kinds = new Map(servos.map((servo) => [JSON.stringify(servo), servo]));
    for (const servo of kinds.values()) {
      const limit = (v) => caudata.drivingLimit(servo, v * servo.taper_at_radps) / servo.tau_max_nm;
      sheet.line(axes, speeds, speeds.map((v) => limit(v)), theme.bad, 1.5);
      sheet.line(axes, speeds, speeds.map((v) => -limit(-v)), theme.bad, 1.5);
    }
    sheet.key([{ label: "other joints", color: theme.feet[1], dot: true }, { label: "legs", color: theme.accent, dot: true }, { label: "envelope", color: theme.bad }], 62, 11);
  }

  path() {
    const sheet = this.sheets.path;
    if (!this.film) return sheet.empty("no film of this scenario");
    const { film } = this;
    if (this.drawn.path) sheet.restore();
    else this.way(sheet);
    const { ctx, theme } = sheet, axes = this.axes.path;
    sheet.clip(axes, () => {
      const [x, y] = film.com(this.frame), a = film.heading(this.frame);
      ctx.fillStyle = theme.bad;
      ctx.beginPath();
      for (const [along, side] of [[13, 0], [-8, 6], [-8, -6]]) ctx.lineTo(axes.px(x) + along * Math.cos(a) - side * Math.sin(a), axes.py(y) - along * Math.sin(a) - side * Math.cos(a));
      ctx.fill();
    });
  }

  // All of the path but where the robot is.
  way(sheet) {
    sheet.begin();
    const { theme, width, height, ctx } = sheet, { film } = this;
    const xs = [], ys = [];
    for (let r = 0; r < film.frames; r += 2) { const [x, y] = film.com(r); xs.push(x); ys.push(y); }
    // one scale for both axes
    const [w, h] = [width - 72, height - 42];
    let [x0, x1] = caudata.range([xs], 1.5), [y0, y1] = caudata.range([ys], 1.5);
    const per = Math.max((x1 - x0) / w, (y1 - y0) / h);
    const grow = (a, b, size) => [(a + b - per * size) / 2, (a + b + per * size) / 2];
    [x0, x1] = grow(x0, x1, w); [y0, y1] = grow(y0, y1, h);
    const axes = sheet.axes({ box: [62, 6, 62 + w, 6 + h], x: [x0, x1], y: [y0, y1], xTicks: 5, yTicks: 4, xLabel: "x, m", yLabel: "y, m" });
    if (film.water !== null) sheet.clip(axes, () => {
      ctx.fillStyle = theme.water;
      for (let px = axes.box[0]; px < axes.box[2]; px += 6) for (let py = axes.box[1]; py < axes.box[3]; py += 6) {
        const x = x0 + (px + 3 - axes.box[0]) * per, y = y1 - (py + 3 - axes.box[1]) * per;
        if (caudata.groundHeight(film, x, y) < film.water) ctx.fillRect(px, py, 6, 6);
      }
    });
    sheet.line(axes, xs, ys, theme.accent, 2);
    const every = Math.round(1 / film.period);
    sheet.clip(axes, () => {
      ctx.fillStyle = theme.accent;
      for (let r = 0; r < film.frames; r += every) { const [x, y] = film.com(r); ctx.beginPath(); ctx.arc(axes.px(x), axes.py(y), 2.6, 0, 7); ctx.fill(); }
    });
    this.axes.path = axes;
    this.drawn.path = true;
    sheet.keep();
  }
};
