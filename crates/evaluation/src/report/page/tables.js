// Tables and headings of an evaluation.

caudata.mark = (ok, yes = "met", no = "missed") => caudata.el("td", { class: ok ? "good" : "bad" }, ok ? `✓ ${yes}` : `✗ ${no}`);

// null: not about walking.
caudata.walks = (scenario) => {
  if (!scenario.gates) return null;
  return scenario.gates.walks && scenario.fall_share.mean <= 0.05;
};

caudata.verdict = (scenario) => {
  const walks = caudata.walks(scenario);
  if (walks === null) return "";
  if (walks) return "walks: every gate is met";
  const missed = scenario.gates.gates.filter((g) => !g.met).map((g) => g.name);
  return missed.length ? `does not walk: ${missed.join("; ")}` : "does not walk: it falls too often";
};

caudata.header = (page) => {
  const { el, number, percent } = caudata;
  const { about, result } = page;
  const flat = result.scenarios.find((s) => s.name === "flat 0.3 m/s") || result.scenarios[0];
  const cards = [];
  const card = (value, label, kind) => cards.push(el("div", { class: "card" }, el("b", { class: kind || "" }, value), el("span", {}, label)));
  if (flat) {
    const walks = caudata.walks(flat);
    card(`${number(flat.vx_mps.mean, 3)} m/s`, `forward, ${flat.name}`);
    card(`${number(flat.power_w.mean, 1)} W`, "mean joint power there");
    if (walks !== null) card(walks ? "walks" : "does not walk", walks ? "every gate met there" : "a gate missed there", walks ? "good" : "bad");
    card(percent(flat.fall_share.mean), "of its episodes fall", flat.fall_share.mean > 0.05 ? "bad" : "");
  }
  const shore = result.scenarios.find((s) => s.transition && s.transition.swim_speed_mps && s.transition.reached.mean > 0.5);
  if (shore) card(`${number(shore.transition.swim_speed_mps.mean, 3)} m/s`, `swimming, ${shore.name}`);
  const rows = result.acceptance;
  if (rows.length) {
    const met = rows.filter((r) => r.met).length;
    card(`${met} of ${rows.length}`, "targets met", met === rows.length ? "good" : "warn");
  }
  const sha = result.policy_sha256.slice(0, 12);
  const from = [`policy ${result.policy_version}`, `robot ${about.robot}`, `suite ${result.suite}`, `engine ${result.engine}`];
  document.getElementById("top").append(
    el("h1", {}, `How policy ${result.policy_version} walks`),
    el("p", { class: "soft" }, from.slice(1).join(" · "), ` · ${(about.env_steps / 1e6).toFixed(1)} million training steps · seed ${about.seed}`),
    el("p", { class: "soft small" }, "policy ", el("code", { title: result.policy_sha256 }, sha), " · robot files ", el("code", { title: about.robot_hash }, about.robot_hash.slice(0, 12)),
      ` · run ${about.run_id}`, about.training_commit ? ` · commit ${about.training_commit.slice(0, 12)}` : "", ` · the first ${about.settle_s} s of each episode are left out of means; intervals are 95 %`),
    el("div", { class: "cards" }, ...cards));
};

// The robot from above with these positions of its actuated joints: links as lines, feet as dots, head to the right.
caudata.fromAbove = (robot, joints, kind) => {
  const full = robot.joints.map(() => 0);
  robot.actuated.forEach((j, i) => { full[j] = joints[i]; });
  const poses = caudata.linkPoses(robot, { pos: [0, 0, 0], quat: [1, 0, 0, 0], joints: full });
  const lines = robot.links.flatMap((link, l) => (link.parent === null ? [] : [[poses[link.parent].pos, poses[l].pos]]));
  const feet = robot.feet.map((f) => caudata.add(poses[f.link].pos, caudata.rotate(poses[f.link].quat, f.centre_m)));
  robot.feet.forEach((f, i) => lines.push([poses[f.link].pos, feet[i]]));
  return { kind, lines, feet };
};

// Each joint's mean while walking, as numbers and from above, the nominal pose beneath in grey.
caudata.postures = (page, section) => {
  const { el, number, table } = caudata;
  const held = page.result.scenarios.filter((s) => s.posture && s.gates && s.gates.gates.length);
  if (!held.length) return;
  const deg = 180 / Math.PI;
  const svg = (tag, attributes, ...children) => {
    const node = document.createElementNS("http:" + "//www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.append(...children);
    return node;
  };
  const picture = (s) => {
    const views = [caudata.fromAbove(page.robot, s.posture.nominal_rad, "soft"), caudata.fromAbove(page.robot, s.posture.mean_rad, "now")];
    const points = views.flatMap((v) => [...v.lines.flat(), ...v.feet]);
    const [xs, ys] = [points.map((p) => p[0]), points.map((p) => -p[1])];
    const room = 0.03, x0 = Math.min(...xs) - room, y0 = Math.min(...ys) - room;
    const box = [x0, y0, Math.max(...xs) + room - x0, Math.max(...ys) + room - y0].map((x) => x.toFixed(3)).join(" ");
    const shapes = views.flatMap((v) => {
      const color = v.kind === "now" ? "var(--accent)" : "var(--line)";
      return [...v.lines.map(([a, b]) => svg("line", { x1: a[0], y1: -a[1], x2: b[0], y2: -b[1], stroke: color, "stroke-width": 0.012, "stroke-linecap": "round" })),
        ...v.feet.map((f) => svg("circle", { cx: f[0], cy: -f[1], r: 0.014, fill: color }))];
    });
    return el("figure", {}, el("figcaption", {}, el("b", {}, s.name)), svg("svg", { viewBox: box, width: "100%", role: "img", "aria-label": `mean posture from above, ${s.name}` }, ...shapes));
  };
  const rows = held.map((s) => [s.name, ...s.posture.mean_rad.map((q, j) => {
    const off = (q - s.posture.nominal_rad[j]) * deg;
    const stop = s.posture.at_stop_share[j] > 0.02 ? `, at its stop ${caudata.percent(s.posture.at_stop_share[j], 0)}` : "";
    return el("td", { class: Math.abs(off) > 10 || stop ? "bad" : "" }, `${number(off, 0)} ± ${number(s.posture.swing_rad[j] * deg, 0)}${stop}`);
  })]);
  section("Posture", "Each joint's mean while walking and its standard deviation, degrees off the nominal pose; below from above, the nominal pose in grey.",
    table(["scenario", ...page.joint_names], rows), el("div", { class: "plots" }, ...held.slice(0, 4).map(picture)));
};

caudata.tables = (page) => {
  const { el, number, table, mark } = caudata;
  const { result } = page;
  const out = document.getElementById("tables");
  const section = (title, note, ...content) => out.append(el("h2", {}, title), ...(note ? [el("p", { class: "soft small" }, note)] : []), ...content);

  if (result.acceptance.length) {
    const rows = result.acceptance.map((r) => {
      const sign = r.at_least ? "≥ " : "≤ ";
      const unit = r.unit === "1" ? "" : ` ${r.unit}`;
      const digits = Math.abs(r.measured) < 0.1 ? 4 : 3;
      return [r.name, `${sign}${r.owed}${unit}`, `${sign}${r.aim}${unit}`, `${number(r.measured, digits)}${r.measured === null ? "" : unit}`,
        r.measured === null ? el("td", { class: "soft" }, "–") : mark(r.met, r.aim_met ? "aim" : "met"), el("td", { class: "text soft" }, r.note)];
    });
    section("Targets", "A figure of walking counts only where its gait gates are met.", table(["target", "owed", "aim", "measured", "", "note"], rows));
  }

  if (result.animal.length) {
    const rows = result.animal.map((r) => [r.name, r.animal[0] === r.animal[1] ? number(r.animal[0], 2) : `${number(r.animal[0], 2)} to ${number(r.animal[1], 2)}`, r.unit === "1" ? "" : r.unit, number(r.robot, 2), number(r.score, 2), el("td", { class: "text soft" }, r.source)]);
    section("Beside a salamander", "Published kinematics of walking and swimming animals; score 1 within their range, else the smaller over the larger.", table(["quantity", "salamander", "", "here", "score", "source"], rows));
  }

  const compared = page.paper.filter((row) => row.measured);
  if (compared.length) {
    const rows = compared.map(({ name, paper_mps, measured: m }) => [name, number(paper_mps, 2), caudata.estimate(m), `${number(m.mean / paper_mps, 2)} ×`, m.walks === null ? "" : mark(m.walks, "walks", "gates")]);
    section("Beside the paper", "Tian, Fu, Ning, Pey, Ijspeert, “Learning Whole-Body Control for a Salamander Robot”: the robot's speed at a 0.3 m/s command. Theirs is measured on the robot, ours in simulation.",
      table(["ground", "paper, m/s", "here, m/s", "over the paper", ""], rows));
  }

  // columns of what only some scenarios are about
  const about = [
    ["gets there", (s) => s.arrived, (a) => caudata.percent(a.mean)],
    ["on its feet within 3 s, at the end", (s) => s.righting, (r) => `${caudata.percent(r.in_time.mean)}, ${caudata.percent(r.upright.mean)}`],
  ].filter(([, of]) => result.scenarios.some(of));
  const rows = result.scenarios.map((s, i) => [
    el("td", {}, el("button", { type: "button", onclick: () => caudata.select(i, true) }, s.name)),
    `${s.episodes}`, `${number(s.command[0])}, ${number(s.command[1])}, ${number(s.command[2])}`,
    caudata.estimate(s.vx_mps), caudata.estimate(s.vy_mps), caudata.estimate(s.yaw_rate_radps), s.rmse_of_means.map((x) => number(x, 3)).join(" "),
    caudata.percent(s.fall_share.mean), ...about.map(([, of, show]) => (of(s) ? show(of(s)) : "–")), caudata.estimate(s.power_w, 1), number(s.cost_of_transport.mean), number(s.torque_rms_nm), number(s.torque_peak_nm), caudata.percent(s.servo_limit_share), number(s.joint_speed_peak_radps, 1), number(s.joint_accel_rms_radps2, 0)]);
  section("Every scenario", "Velocities of the whole body in the heading frame; rms: over episodes, mean velocity against the command.", table(
    ["scenario", "episodes", "mean command", "vx, m/s", "vy, m/s", "yaw, rad/s", "rms off the command", "falls", ...about.map(([head]) => head), "power, W", "cost of transport", "torque rms, N·m", "peak", "at the servo's limit", "speed peak, rad/s", "accel rms, rad/s²"], rows));

  const judged = result.scenarios.filter((s) => s.gates && s.gates.gates.length);
  if (judged.length) {
    const names = judged.map((s) => s.gates.gates).reduce((a, b) => (b.length > a.length ? b : a)).map((g) => g);
    const limit = (x) => +x.toFixed(3);
    const head = names.map((g) => `${g.name} ${g.at_least === null ? "≤ " + limit(g.at_most) : "≥ " + limit(g.at_least)}`);
    const lines = judged.map((s) => [s.name, ...names.map((n) => {
      const g = s.gates.gates.find((x) => x.name === n.name);
      return g ? el("td", { class: g.met ? "" : "bad" }, (g.met ? "" : "✗ ") + number(g.value, 3)) : el("td", { class: "soft" }, "–");
    }), mark(caudata.walks(s), "walks", "no")]);
    section("Is it walking?", "Speed can be had by vibrating. These gates cannot, and a figure that misses one is not called walking.", table(["scenario", ...head, ""], lines));
  }

  caudata.postures(page, section);

  const shores = result.scenarios.filter((s) => s.transition);
  if (shores.length) {
    const pair = (values, show) => values.map(show).join(" → ");
    const lines = shores.map(({ name, transition: t }) => [name, caudata.percent(t.reached.mean), caudata.estimate(t.reached_s, 1), caudata.estimate(t.swim_speed_mps), caudata.estimate(t.swim_power_w, 1),
      pair(t.leg_swing_rad, (x) => number(x, 3)), caudata.percent(t.leg_swing_kept, 0), pair(t.foot_contact, (x) => caudata.percent(x, 0)),
      t.wave_in_water ? mark(t.wave_in_water.travels_to_the_tail, "to the tail", "no") : "–"]);
    section("Across the shore", "On land: centre of mass half a body length before the waterline; in water: a whole one beyond it. Leg swing: standard deviation of the leg joints, rad.",
      table(["scenario", "reached", "after, s", "swimming, m/s", "power, W", "leg swing, land → water", "kept", "feet touch, land → water", "wave in water"], lines));
  }

  if (result.referee) {
    const lines = result.referee.scenarios.map((r) => {
      const s = result.scenarios.find((x) => x.name === r.name);
      const kept = s && s.vx_mps.mean ? r.vx_mps.mean / s.vx_mps.mean : null;
      return [r.name, `${r.episodes}`, s ? caudata.estimate(s.vx_mps) : "–", caudata.estimate(r.vx_mps), caudata.percent(kept), caudata.percent(r.fall_share.mean), number(r.power_w.mean, 1), el("td", { class: "text soft" }, caudata.verdict(r))];
    });
    section("On the second engine", null, table(["scenario", "episodes", `vx on ${result.engine}, m/s`, `vx on ${result.referee.engine}, m/s`, "kept", "falls", "power, W", ""], lines));
  }
};
