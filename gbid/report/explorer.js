// The gain explorer: reads its controls, solves the loop (ExplorerMath), shows what comes out.
"use strict";

const Explorer = (() => {
  const IMPACT = { count: 1001, step: 2e-4 };
  const KEYS = { pressure: "P", speed: "n", kappa_x: "kx", kappa_y: "ky", corner: "fc" };
  let model = null;
  let root = null;
  let drawing = 0;

  const control = (name) => root.querySelector(`#explore-${name}`);

  function settings() {
    const value = (name) => Number(control(name).value);
    return {
      pressure: value("pressure"),
      speed: value("speed"),
      gains: [value("kappa_x"), value("kappa_y")],
      corner: value("corner"),
      axis: Number(control("axis").value),
    };
  }

  const logSpaced = (low, high, n) => Array.from({ length: n }, (_, i) => low * (high / low) ** (i / (n - 1)));

  // Largest singular value of S_o over frequency: the best of rest, grid and modes' frequencies, then golden sections.
  function peak(s, grid, curve, modes) {
    const value = (f) => ExplorerMath.largestSingularValue(ExplorerMath.sensitivityAt(model, s, f));
    const candidates = [0, ...grid, ...modes.map((m) => m.frequency)];
    const values = [value(0), ...curve, ...modes.map((m) => value(m.frequency))];
    const at = candidates[values.indexOf(Math.max(...values))];
    if (at === 0) return { value: values[0], frequency: 0 };
    let [low, high] = [at / 1.04, at * 1.04];
    const ratio = (Math.sqrt(5) - 1) / 2;
    for (let i = 0; i < 60; i++) {
      const [a, b] = [high - ratio * (high - low), low + ratio * (high - low)];
      if (value(a) > value(b)) high = b;
      else low = a;
    }
    return { value: value((low + high) / 2), frequency: (low + high) / 2 };
  }

  function solve(s) {
    const grid = logSpaced(model.frequency[0], model.frequency[1], 300);
    const modes = ExplorerMath.modes(model, s);
    const curve = ExplorerMath.sensitivity(model, s, grid);
    const response = (at) => (model.impact ? ExplorerMath.impactResponse(model, at, { ...model.impact, axis: s.axis }, IMPACT.step, IMPACT.count) : []);
    const off = { ...s, gains: [0, 0] };
    return {
      grid,
      modes,
      curve,
      open: ExplorerMath.modes(model, off),
      damping: Math.min(...modes.oscillatory.map((m) => m.damping), modes.real.some((p) => p >= 0) ? -1 : Infinity),
      peak: modes.stable ? peak(s, grid, curve.largest, modes.oscillatory) : { value: Infinity, frequency: NaN },
      rest: modes.stable ? ExplorerMath.largestSingularValue(ExplorerMath.sensitivityAt(model, s, 0)) : Infinity,
      closedImpact: response(s),
      openImpact: response(off),
    };
  }

  const fixed = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits).replace("-", "−") : "∞");

  function verdict(s, found) {
    const box = control("verdict");
    box.className = found.modes.stable ? "verdict good" : "verdict bad";
    if (!found.modes.stable) {
      const worst = found.modes.values.reduce((a, b) => (b[0] > a[0] ? b : a));
      const how = worst[1] === 0 ? "a real pole grows: the feedback takes more stiffness away than there is" : `the mode at ${fixed(Math.hypot(...worst) / (2 * Math.PI), 1)} Hz grows`;
      box.textContent = `Unstable: ${how}.`;
      return;
    }
    box.textContent =
      `Stable. Smallest damping factor ${fixed(found.damping, 3)}; peak of S_o ${fixed(found.peak.value, 3)} at ` +
      `${fixed(found.peak.frequency, 1)} Hz; static amplification ${fixed(found.rest, 3)}.`;
    const cap = model.peak_sensitivity;
    if (found.peak.value > cap) {
      box.className = "verdict warn";
      box.textContent += ` The peak is above ${cap}, the cap that tuning keeps by default.`;
    }
  }

  function table(found) {
    const body = control("modes");
    body.replaceChildren();
    const row = (cells) => {
      const tr = document.createElement("tr");
      cells.forEach((text, i) => tr.appendChild(Object.assign(document.createElement(i ? "td" : "th"), { textContent: text })));
      tr.firstChild.scope = "row";
      body.appendChild(tr);
    };
    for (const m of found.modes.oscillatory) row(["oscillatory", fixed(m.frequency, 2), fixed(m.damping, 4), fixed(-m.re, 1)]);
    for (const p of found.modes.real) row(["real", "–", "–", fixed(-p, 1)]);
  }

  function plots(s, found) {
    const hz = (values) => values.map((v) => v / (2 * Math.PI));
    const near = (list) => list.filter((m) => m.frequency < 400);
    const realNear = found.modes.real.filter((p) => Math.abs(p) < 2 * Math.PI * 150);
    const closed = near(found.modes.oscillatory);
    const open = near(found.open.oscillatory);
    Charts.draw(control("plane"), {
      title: `Poles: ${closed.map((m) => `${fixed(m.frequency, 1)} Hz with damping ${fixed(m.damping, 3)}`).join(", ")}`,
      x: { label: "real part / 2π [Hz]", zero: true, atLeast: 12, atMost: -110 },
      y: { label: "imaginary part / 2π [Hz]", atLeast: 160, min: -6 },
      rays: [0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7],
      height: 320,
      points: [
        { name: "open loop", style: 1, kind: 4, x: hz(open.map((m) => m.re)), y: hz(open.map((m) => m.im)) },
        {
          name: "closed loop", style: 0, kind: 0,
          x: hz([...closed.map((m) => m.re), ...realNear]), y: hz([...closed.map((m) => m.im), ...realNear.map(() => 0)]),
        },
      ],
    });
    Charts.draw(control("sensitivity"), {
      title: `Magnitude of S_o, peak ${fixed(found.peak.value, 2)} at ${fixed(found.peak.frequency, 0)} Hz`,
      x: { label: "frequency [Hz]", log: true, min: found.grid[0], max: found.grid[found.grid.length - 1] },
      y: { label: "magnitude of S_o [-]", log: true, atMost: 0.5, atLeast: 5 },
      height: 280,
      series: [
        { name: "largest singular value", style: 0, x: found.grid, y: found.curve.largest },
        { name: "x from x", style: 1, x: found.grid, y: found.curve.xx },
        { name: "y from y", style: 2, x: found.grid, y: found.curve.yy },
      ],
    });
    if (!model.impact) return; // the moving mass is not known
    const time = found.closedImpact.map((_, i) => 1e3 * IMPACT.step * i);
    const part = (positions) => positions.map((p) => 1e6 * p[s.axis]);
    const openPart = part(found.openImpact);
    const reach = Math.max(...openPart.map(Math.abs)) * 3;
    const closedPart = part(found.closedImpact).map((v) => (Math.abs(v) > reach ? NaN : v));
    const name = "xy"[s.axis];
    Charts.draw(control("impact"), {
      title: `Disc position ${name} after an impact along ${name}, open and closed loop`,
      x: { label: "time [ms]", min: 0, max: time[time.length - 1] },
      y: { label: `disc position ${name} [µm]` },
      height: 280,
      series: [
        { name: "open loop", style: 1, x: time, y: openPart },
        { name: found.modes.stable ? "closed loop" : "closed loop (unstable, cut off)", style: 0, x: time, y: closedPart },
      ],
    });
  }

  // Full numbers in the page, for those who check them: #explore&...&dump
  function dump(s, found) {
    const place = document.getElementById("explorer-results");
    place.textContent = JSON.stringify({
      settings: s,
      eigenvalues: found.modes.values,
      stable: found.modes.stable,
      damping: found.damping,
      peak: found.peak,
      static_amplification: found.rest,
      frequency_hz: found.grid,
      largest: found.curve.largest,
      xx: found.curve.xx,
      yy: found.curve.yy,
      time_s: found.closedImpact.map((_, i) => IMPACT.step * i),
      position_m: found.closedImpact,
    });
  }

  function writeHash(s) {
    const values = { pressure: s.pressure, speed: s.speed, kappa_x: s.gains[0], kappa_y: s.gains[1], corner: s.corner };
    const text = Object.entries(KEYS).map(([name, key]) => `${key}=${values[name]}`).join("&");
    try {
      history.replaceState(null, "", `#explore&${text}&axis=${"xy"[s.axis]}`);
    } catch {
      // some browsers refuse this for files; the page works without it
    }
  }

  function readHash() {
    const words = location.hash.slice(1).split("&");
    if (words[0] !== "explore") return false;
    const given = Object.fromEntries(words.slice(1).map((word) => word.split("=")));
    for (const [name, key] of Object.entries(KEYS)) {
      const value = Number(given[key]);
      if (key in given && Number.isFinite(value)) set(name, value);
    }
    if (given.axis) control("axis").value = String(Math.max(0, "xy".indexOf(given.axis)));
    return words.includes("dump");
  }

  function set(name, value) {
    const box = control(name);
    const slider = control(`${name}-slider`);
    const held = Math.min(Number(box.max), Math.max(Number(box.min), value));
    box.value = String(held);
    slider.value = String(held);
  }

  function update(keepHash = false, dumped = false) {
    const s = settings();
    const found = solve(s);
    verdict(s, found);
    table(found);
    plots(s, found);
    if (dumped) dump(s, found);
    else if (!keepHash) writeHash(s);
  }

  function later() {
    cancelAnimationFrame(drawing);
    drawing = requestAnimationFrame(() => update());
  }

  function connect() {
    for (const name of Object.keys(KEYS)) {
      control(`${name}-slider`).addEventListener("input", (event) => {
        control(name).value = event.target.value;
        later();
      });
      control(name).addEventListener("change", (event) => {
        if (event.target.value !== "" && Number.isFinite(Number(event.target.value))) set(name, Number(event.target.value));
        else event.target.value = control(`${name}-slider`).value;
        later();
      });
    }
    control("axis").addEventListener("change", later);
    for (const button of root.querySelectorAll("button[data-gains]")) {
      button.addEventListener("click", () => {
        const [kx, ky, corner] = JSON.parse(button.dataset.gains);
        set("kappa_x", kx);
        set("kappa_y", ky);
        if (corner) set("corner", corner);
        later();
      });
    }
  }

  function start() {
    const data = document.getElementById("explorer-model");
    root = document.getElementById("explore");
    if (!data || !root) return;
    model = JSON.parse(data.textContent);
    root.querySelector("fieldset").disabled = false;
    connect();
    const dumped = readHash();
    update(true, dumped);
    if (location.hash.startsWith("#explore")) root.scrollIntoView();
    window.addEventListener("hashchange", () => location.hash.startsWith("#explore&") && update(true, readHash()));
    window.addEventListener("resize", () => update(true));
    window.addEventListener("beforeprint", () => update(true));
  }

  return { start };
})();
