// A canvas with axes, lines and bands: what every chart of every page is drawn with.

caudata.palette = (dark) => ({
  // head to tail: eight steps from blue over green to orange, told apart by lightness as well
  chain: dark ? ["#5aa9e6", "#4fb8c9", "#53c29b", "#84c967", "#b9c74e", "#e3bb4b", "#f0994f", "#ee7164"]
    : ["#14508c", "#14708f", "#138271", "#3f8f45", "#7d8c1f", "#b07d14", "#c96219", "#bd3f32"],
  feet: dark ? ["#5aa9e6", "#f0994f", "#53c29b", "#d98bd0"] : ["#14508c", "#c05f14", "#138271", "#9b3d90"],
});

caudata.theme = () => {
  const style = getComputedStyle(document.documentElement);
  const get = (name) => style.getPropertyValue(name).trim();
  const dark = window.matchMedia("(prefers-color-scheme: dark)").matches;
  return { ink: get("--ink"), soft: get("--soft"), line: get("--line"), faint: get("--faint"), card: get("--card"), accent: get("--accent"),
    command: get("--command"), band: get("--band"), bad: get("--bad"), good: get("--good"), water: get("--water"), dark, ...caudata.palette(dark) };
};

// A canvas with one or more boxes of axes.
caudata.Sheet = class {
  constructor(canvas) {
    this.canvas = canvas;
    this.ctx = canvas.getContext("2d");
  }

  begin() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.width = this.canvas.clientWidth || 600;
    this.height = Number(this.canvas.dataset.height);
    this.canvas.style.height = `${this.height}px`;
    const [w, h] = [Math.round(this.width * ratio), Math.round(this.height * ratio)];
    if (this.canvas.width !== w || this.canvas.height !== h) { this.canvas.width = w; this.canvas.height = h; }
    this.ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.ctx.clearRect(0, 0, this.width, this.height);
    this.theme = caudata.theme();
    this.ctx.font = "12px system-ui, 'DejaVu Sans', sans-serif";
    this.ctx.lineJoin = "round";
    return this;
  }

  empty(text) {
    this.begin();
    this.text(text, this.width / 2, this.height / 2, { align: "center", color: this.theme.soft });
  }

  // What is drawn so far, to be put back before a moving part is drawn again.
  keep() {
    this.kept = this.kept || document.createElement("canvas");
    this.kept.width = this.canvas.width; this.kept.height = this.canvas.height;
    this.kept.getContext("2d").drawImage(this.canvas, 0, 0);
  }

  restore() {
    this.begin();
    this.ctx.drawImage(this.kept, 0, 0, this.width, this.height);
  }

  text(text, x, y, { align = "left", base = "middle", color, turn } = {}) {
    const { ctx } = this;
    ctx.save();
    ctx.fillStyle = color || this.theme.ink;
    ctx.textAlign = align;
    ctx.textBaseline = base;
    ctx.translate(x, y);
    if (turn) ctx.rotate(turn);
    // readable where a curve passes
    ctx.strokeStyle = this.theme.card; ctx.lineWidth = 3;
    ctx.strokeText(text, 0, 0);
    ctx.fillText(text, 0, 0);
    ctx.restore();
  }

  // Axes: box [left, top, right, bottom] in pixels, ranges, labels. Ticks and grid as asked.
  axes({ box, x, y, xLabel, yLabel, xTicks = 8, yTicks = 4, xText = true, yText = true }) {
    const { ctx, theme } = this;
    const [l, t, r, b] = box;
    const px = (v) => l + (v - x[0]) / (x[1] - x[0]) * (r - l), py = (v) => b - (v - y[0]) / (y[1] - y[0]) * (b - t);
    ctx.lineWidth = 1;
    const digits = (ticks) => (ticks.length > 1 ? Math.max(0, -Math.floor(Math.log10(Math.abs(ticks[1] - ticks[0])) + 1e-9)) : 1);
    if (xTicks) {
      const ticks = caudata.ticks(...x, xTicks), d = digits(ticks);
      for (const v of ticks) {
        ctx.strokeStyle = theme.faint;
        ctx.beginPath(); ctx.moveTo(px(v), t); ctx.lineTo(px(v), b); ctx.stroke();
        if (xText) this.text(caudata.number(v, d), px(v), b + 5, { align: "center", base: "top", color: theme.soft });
      }
    }
    if (yTicks) {
      const ticks = caudata.ticks(...y, yTicks), d = digits(ticks);
      for (const v of ticks) {
        ctx.strokeStyle = Math.abs(v) < 1e-12 ? theme.line : theme.faint;
        ctx.beginPath(); ctx.moveTo(l, py(v)); ctx.lineTo(r, py(v)); ctx.stroke();
        if (yText) this.text(caudata.number(v, d), l - 6, py(v), { align: "right", color: theme.soft });
      }
    }
    ctx.strokeStyle = theme.line;
    ctx.strokeRect(l, t, r - l, b - t);
    if (xLabel) this.text(xLabel, r, b + 19, { align: "right", base: "top", color: theme.soft });
    if (yLabel) this.text(yLabel, l - 40, (t + b) / 2, { align: "center", color: theme.soft, turn: -Math.PI / 2 });
    return { box, x, y, px, py };
  }

  clip(axes, draw) {
    const { ctx } = this, [l, t, r, b] = axes.box;
    ctx.save(); ctx.beginPath(); ctx.rect(l, t, r - l, b - t); ctx.clip();
    draw(ctx);
    ctx.restore();
  }

  line(axes, xs, ys, color, width = 1.5, dash = []) {
    this.clip(axes, (ctx) => {
      ctx.strokeStyle = color; ctx.lineWidth = width; ctx.setLineDash(dash);
      ctx.beginPath();
      for (let i = 0; i < ys.length; i++) ctx.lineTo(axes.px(xs[i]), axes.py(ys[i]));
      ctx.stroke();
    });
  }

  band(axes, xs, low, high, color) {
    this.clip(axes, (ctx) => {
      ctx.fillStyle = color;
      ctx.beginPath();
      for (let i = 0; i < xs.length; i++) ctx.lineTo(axes.px(xs[i]), axes.py(high[i]));
      for (let i = xs.length - 1; i >= 0; i--) ctx.lineTo(axes.px(xs[i]), axes.py(low[i]));
      ctx.fill();
    });
  }

  cursor(axes, time) {
    const { ctx, theme } = this, [, t, , b] = axes.box;
    if (time < axes.x[0] || time > axes.x[1]) return;
    ctx.strokeStyle = theme.bad; ctx.lineWidth = 1;
    ctx.beginPath(); ctx.moveTo(axes.px(time), t - 2); ctx.lineTo(axes.px(time), b + 2); ctx.stroke();
  }

  key(entries, x, y) {
    const { ctx } = this;
    // on a telephone the words are smaller, so that all of them are there
    const needed = entries.reduce((sum, { label }) => sum + 36 + ctx.measureText(label).width, 0);
    ctx.save();
    ctx.font = ctx.font.replace("12px", `${Math.max(7, 12 * Math.min(1, (this.width - x) / needed))}px`);
    for (const { label, color, band, dash = [], dot } of entries) {
      if (band) { ctx.fillStyle = color; ctx.fillRect(x, y - 5, 18, 10); }
      else if (dot) { ctx.fillStyle = color; ctx.beginPath(); ctx.arc(x + 9, y, 3.5, 0, 7); ctx.fill(); }
      else { ctx.strokeStyle = color; ctx.lineWidth = 2; ctx.setLineDash(dash); ctx.beginPath(); ctx.moveTo(x, y); ctx.lineTo(x + 18, y); ctx.stroke(); ctx.setLineDash([]); }
      this.text(label, x + 23, y, { color: this.theme.soft });
      x += 36 + ctx.measureText(label).width;
    }
    ctx.restore();
  }
};

// Range of some values with a margin; at least `least` wide.
caudata.range = (arrays, least = 0.1) => {
  let low = Infinity, high = -Infinity;
  for (const values of arrays) for (const v of values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
  if (low > high) return [0, 1];
  const pad = Math.max(0.06 * (high - low), (least - (high - low)) / 2);
  return [low - pad, high + pad];
};
