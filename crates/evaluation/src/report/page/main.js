// The page, put together. Errors are shown and counted, so that a test in a browser can see them.

caudata.start = () => {
  const root = document.documentElement;
  root.dataset.errors = "0";
  window.addEventListener("error", (e) => {
    root.dataset.errors = Number(root.dataset.errors) + 1;
    root.dataset.error = e.message;
  });
  const page = JSON.parse(document.getElementById("data").textContent);
  const { el } = caudata;
  caudata.page = page;
  caudata.header(page);
  let plots = null;
  const replay = new caudata.Replay(page.robot, page.foot_names, (frame, soon) => { if (plots) plots.at(frame, soon); });
  plots = new caudata.Plots(page, (frame) => { replay.play(false); replay.seek(frame); });
  const nav = document.getElementById("scenarios");
  const buttons = page.result.scenarios.map((s, i) => {
    const walks = caudata.walks(s);
    const kind = walks === null ? "" : walks ? "good" : "bad";
    return el("button", { type: "button", onclick: () => caudata.select(i) }, el("span", { class: `dot ${kind}` }), s.name);
  });
  nav.append(...buttons);

  caudata.select = (index, scroll) => {
    const s = page.result.scenarios[index], data = page.shown[index];
    buttons.forEach((b, i) => b.setAttribute("aria-pressed", i === index));
    const film = data.film ? caudata.openFilm(data.film) : null;
    const line = [`${s.episodes} episodes`, `falls ${caudata.percent(s.fall_share.mean)}`, `forward ${caudata.estimate(s.vx_mps)} m/s`, `power ${caudata.estimate(s.power_w, 1)} W`, caudata.verdict(s)].filter((x) => x);
    const kind = caudata.walks(s) === null ? "" : caudata.walks(s) ? "good" : "bad";
    document.getElementById("scenario").replaceChildren(el("p", {}, el("b", {}, `${s.name}: `), line.slice(0, 4).join(" · "), ...line.slice(4).flatMap((x) => [" · ", el("span", { class: kind }, x)])));
    replay.play(false);
    plots.open(index, film);
    replay.open(film);
    if (scroll) window.scrollTo({ top: 0, behavior: "smooth" });
  };
  caudata.replay = replay;
  caudata.plots = plots;
  caudata.tables(page);
  if (page.result.scenarios.length) {
    caudata.select(0);
    // it walks by then
    if (replay.film) replay.seek(Math.round(page.about.settle_s / replay.film.period));
  }
  root.dataset.ready = "true";
};

if (typeof document !== "undefined") caudata.start();
