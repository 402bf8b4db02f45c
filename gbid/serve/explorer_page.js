// The gain explorer of the server: asks gbid for the loop with the gains of its sliders, and draws what it answers.
"use strict";

(() => {
  const at = (name) => document.getElementById(name);
  const designs = JSON.parse(at("designs").textContent);
  const fixed = (value, digits) => (value === null || !Number.isFinite(value) ? "∞" : value.toFixed(digits).replace("-", "−"));
  const short = (value) => String(Number(value.toPrecision(5)));
  let latest = 0;
  let waiting = null;

  const design = () => designs[Number(at("design").value)];

  function fault(text) {
    const list = at("page-errors");
    list.hidden = !text;
    list.replaceChildren(...(text ? [Object.assign(document.createElement("li"), { textContent: text })] : []));
  }

  function build() {
    const host = at("controls");
    host.replaceChildren();
    for (const c of design().controls) {
      const box = document.createElement("div");
      box.className = "control";
      const label = Object.assign(document.createElement("label"), { htmlFor: `c-${c.name}`, textContent: `${c.label} [${c.unit}]` });
      const range = { min: c.low, max: c.high };
      const slider = Object.assign(document.createElement("input"), { type: "range", ...range, step: c.step, value: c.value });
      slider.setAttribute("aria-label", `${c.label}, slider`);
      const number = Object.assign(document.createElement("input"), { type: "number", id: `c-${c.name}`, ...range, step: "any", value: short(c.value) });
      number.dataset.exact = c.value;
      slider.addEventListener("input", () => { number.value = short(Number(slider.value)); number.dataset.exact = slider.value; soon(); });
      number.addEventListener("input", () => { slider.value = number.value; number.dataset.exact = number.value; soon(); });
      box.append(label, slider, number);
      host.appendChild(box);
    }
    at("impact-words").textContent = design().impact || "";
    at("impact-part").hidden = !design().impact; // the moving mass is not known
    soon();
  }

  function query() {
    const asked = new URLSearchParams({ design: design().name, axis: at("axis").value, sampled: at("sampled").value });
    for (const c of design().controls) asked.set(c.name, at(`c-${c.name}`).dataset.exact);
    return asked;
  }

  function soon() {
    clearTimeout(waiting);
    waiting = setTimeout(solve, 60);
  }

  async function solve() {
    const mine = ++latest;
    try {
      const answer = await fetch(`loop?${query()}`);
      const text = await answer.text();
      if (mine !== latest) return; // an answer to older gains
      if (!answer.ok) throw new Error(text);
      fault("");
      show(JSON.parse(text));
    } catch (error) {
      if (mine === latest) fault(error.message);
    }
  }

  function show(found) {
    const box = at("verdict");
    const cap = design().cap;
    const over = cap !== null && found.peak.value !== null && found.peak.value > cap * 1.0001;
    box.className = found.stable ? (over ? "verdict warn" : "verdict good") : "verdict bad";
    box.textContent = found.stable
      ? `Stable. Smallest damping factor ${fixed(found.damping, 3)}; peak of S_o ${fixed(found.peak.value, 3)} at ${fixed(found.peak.frequency_hz, 1)} Hz; ` +
        `static amplification ${fixed(found.static_amplification, 3)}.${over ? ` The peak is above ${cap}, the limit of this design.` : ""}`
      : "Unstable.";
    const rows = found.modes.map((m) => {
      const row = document.createElement("tr");
      [fixed(m[0], 2), fixed(m[1], 4), fixed(m[2], 1)].forEach((text) => row.appendChild(Object.assign(document.createElement("td"), { textContent: text })));
      return row;
    });
    at("modes").replaceChildren(...rows);
    const near = (modes) => modes.filter((m) => m[0] < 400);
    const x = (modes) => near(modes).map((m) => -m[2] / (2 * Math.PI));
    const y = (modes) => near(modes).map((m) => m[0] * Math.sqrt(Math.max(0, 1 - m[1] ** 2)));
    const real = found.real.filter((p) => Math.abs(p) < 2 * Math.PI * 150).map((p) => p / (2 * Math.PI));
    Charts.draw(at("plane"), {
      title: "Poles of the loop", height: 320, rays: [0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7],
      x: { label: "real part / 2π [Hz]", zero: true, atLeast: 12, atMost: -110 },
      y: { label: "imaginary part / 2π [Hz]", atLeast: 160, min: -6 },
      points: [
        { name: "open loop", style: 1, kind: 4, x: x(found.open_modes), y: y(found.open_modes) },
        { name: "closed loop", style: 0, kind: 0, x: [...x(found.modes), ...real], y: [...y(found.modes), ...real.map(() => 0)] },
      ],
    });
    Charts.draw(at("sensitivity"), {
      title: "Magnitude of S_o", height: 280,
      x: { label: "frequency [Hz]", log: true, min: found.frequency_hz[0], max: found.frequency_hz.at(-1) },
      y: { label: "magnitude of S_o [-]", log: true, atMost: 0.5, atLeast: 5 },
      series: [
        { name: "largest singular value", style: 0, x: found.frequency_hz, y: found.largest },
        { name: "x from x", style: 1, x: found.frequency_hz, y: found.xx },
        { name: "y from y", style: 2, x: found.frequency_hz, y: found.yy },
      ],
    });
    if (!found.time_s.length) return void (document.body.dataset.shown = JSON.stringify({ damping: found.damping, peak: found.peak.value }));
    const axis = at("axis").value;
    const time = found.time_s.map((t) => 1e3 * t);
    const motion = (values) => values.map((v) => (v === null ? NaN : 1e6 * v));
    Charts.draw(at("impact"), {
      title: `Disc position ${axis} after an impact along ${axis}`, height: 280,
      x: { label: "time [ms]", min: 0, max: time.at(-1) },
      y: { label: `disc position ${axis} [µm]` },
      series: [
        { name: "open loop", style: 1, x: time, y: motion(found.open_m) },
        { name: found.closed_m.length ? "closed loop" : "closed loop (unstable, not drawn)", style: 0, x: time.slice(0, found.closed_m.length), y: motion(found.closed_m) },
      ],
    });
    document.body.dataset.shown = JSON.stringify({ damping: found.damping, peak: found.peak.value });
  }

  at("design").addEventListener("change", build);
  for (const name of ["axis", "sampled"]) at(name).addEventListener("change", soon);
  at("reset").addEventListener("click", build);
  window.addEventListener("error", (event) => fault(event.message));
  build();
})();
