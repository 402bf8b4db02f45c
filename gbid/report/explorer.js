// The gain explorer: interpolates the grid of loops that the page has, and draws the map of damping over both gains.
"use strict";

const Explorer = (() => {
  let data = null;
  let root = null;
  const control = (name) => root.querySelector(`#explore-${name}`);
  const gain = (axis) => Number(control(axis).value);
  const fixed = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits).replace("-", "−") : "–");

  // Bilinear interpolation; a missing corner makes the value missing.
  function at(values, x, y) {
    const n = data.gains.length;
    const place = (gain) => Math.min(Math.max(((gain - data.gains[0]) / (data.gains[n - 1] - data.gains[0])) * (n - 1), 0), n - 1);
    const [i, j] = [x, y].map((gain) => Math.min(Math.floor(place(gain)), n - 2));
    const [s, t] = [place(x) - i, place(y) - j];
    let sum = 0;
    for (const [a, b, weight] of [[0, 0, (1 - s) * (1 - t)], [1, 0, s * (1 - t)], [0, 1, (1 - s) * t], [1, 1, s * t]]) {
      if (weight > 0) sum += weight * values[(i + a) * n + j + b];
    }
    return sum;
  }

  function verdict({ damping, peak, still }) {
    const box = control("verdict");
    const over = peak > data.cap;
    const stable = damping > 0 && Number.isFinite(peak);
    box.className = `verdict ${stable ? (over ? "warn" : "good") : "bad"}`;
    const words = `Stable. Smallest damping factor ${fixed(damping, 3)}; peak of S_o ${fixed(peak, 2)}; static amplification ${fixed(still, 2)}.`;
    const above = ` The peak is above ${data.cap}, the cap that tuning keeps by default.`;
    box.textContent = stable ? words + (over ? above : "") : "Unstable, or beside gains that are.";
  }

  function table(x, y) {
    const rows = data.points.map((point) => {
      const row = document.createElement("tr");
      const values = [fixed(at(point.damping, x, y), 3), fixed(at(point.peak, x, y), 2), fixed(at(point.static, x, y), 2)];
      [point.label, ...values].forEach((text, i) => row.appendChild(Object.assign(document.createElement(i ? "td" : "th"), { textContent: text })));
      row.firstChild.scope = "row";
      return row;
    });
    control("points").replaceChildren(...rows);
  }

  function map(point, x, y) {
    const largest = Math.max(...point.damping);
    const level = (i) => (point.damping[i] > 0 && Number.isFinite(point.peak[i]) ? point.damping[i] / largest : NaN);
    const cells = point.damping.map((_, i) => ({ level: level(i), over: point.peak[i] > data.cap }));
    Charts.draw(control("map"), {
      title: `Smallest damping factor over both gains at ${point.label}, at most ${fixed(largest, 3)}`,
      x: { label: "gain κx [m/m]", min: data.gains[0], max: data.gains.at(-1) },
      y: { label: "gain κy [m/m]", min: data.gains[0], max: data.gains.at(-1) },
      height: 380,
      cells: { edges: data.gains, values: cells, name: `the darker, the more damping, up to ${fixed(largest, 3)}; hatched: peak of S_o above ${data.cap}; empty: unstable` },
      points: [
        ...data.designs.map(([name, ...place], i) => ({ name, style: 1, kind: (i + 1) % 5, x: [place[0]], y: [place[1]] })),
        { name: "these gains", style: 0, kind: 0, x: [x], y: [y] },
      ],
      pick: (a, b) => choose(a, b),
    });
  }

  function update() {
    const point = data.points[Number(control("point").value)];
    const [x, y] = [gain("x"), gain("y")];
    verdict({ damping: at(point.damping, x, y), peak: at(point.peak, x, y), still: at(point.static, x, y) });
    table(x, y);
    map(point, x, y);
  }

  function choose(x, y) {
    for (const [axis, value] of [["x", x], ["y", y]]) {
      const held = Math.min(Math.max(value, data.gains[0]), data.gains.at(-1));
      control(axis).value = String(Number(held.toFixed(4)));
      control(`${axis}-slider`).value = String(held);
    }
    update();
  }

  function start() {
    const found = document.getElementById("explorer-data");
    root = document.getElementById("explore");
    if (!found || !root) return;
    data = JSON.parse(found.textContent);
    for (const point of data.points) for (const name of ["damping", "peak", "static"]) point[name] = Charts.curve(point[name]);
    root.querySelector("fieldset").disabled = false;
    for (const axis of "xy") {
      const other = axis === "x" ? () => gain("y") : () => gain("x");
      const moved = (value) => (axis === "x" ? choose(value, other()) : choose(other(), value));
      control(`${axis}-slider`).addEventListener("input", (event) => moved(Number(event.target.value)));
      control(axis).addEventListener("change", (event) => moved(Number(event.target.value) || 0));
    }
    for (const button of root.querySelectorAll("button[data-x]")) {
      button.addEventListener("click", () => choose(Number(button.dataset.x), Number(button.dataset.y)));
    }
    control("point").addEventListener("change", update);
    window.addEventListener("resize", update);
    choose(...data.designs.at(-1).slice(1));
  }

  return { start };
})();
