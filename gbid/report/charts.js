// Line charts as SVG, as wide as the place they stand in, so that their words keep their size on a phone.
"use strict";

const Charts = (() => {
  const SVG = "http://www.w3.org/2000/svg";
  const MARGIN = { left: 58, right: 20, top: 10, bottom: 42 };

  function node(parent, name, attributes = {}, text = null) {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== null) made.textContent = text;
    parent.appendChild(made);
    return made;
  }

  // Numbers of a page: 16-bit integers with a factor; -32768 is a missing one.
  function curve({ scale, values }) {
    const bytes = Uint8Array.from(atob(values), (c) => c.charCodeAt(0));
    return Array.from(new Int16Array(bytes.buffer), (v) => (v === -32768 ? NaN : v * scale));
  }

  // Values at which an axis is labelled: 1, 2 or 5 times a power of ten apart.
  function ticks(low, high, wanted) {
    const rough = (high - low) / Math.max(wanted, 1);
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough * 0.999);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    return found.length > 1 || wanted > 20 ? found : ticks(low, high, 2 * wanted); // one label alone is no scale
  }

  function logTicks(low, high) {
    const found = [];
    for (let decade = Math.floor(Math.log10(low)); decade <= Math.log10(high); decade++) {
      for (const m of [1, 2, 5]) if (m * 10 ** decade >= low * 0.999 && m * 10 ** decade <= high * 1.001) found.push(m * 10 ** decade);
    }
    return found;
  }

  const number = (value) => {
    const shown = Math.abs(value) < 1e-12 ? "0" : String(Number(value.toPrecision(6)));
    return shown.replace("-", "−");
  };

  function scale(axis, from, to) {
    const place = axis.log ? Math.log : (v) => v;
    const low = place(axis.min);
    const span = place(axis.max) - low || 1;
    return (value) => from + ((place(value) - low) / span) * (to - from);
  }

  // Range of an axis from what is drawn, where it is not given.
  function fitted(axis, values) {
    const finite = values.filter((v) => Number.isFinite(v) && (!axis.log || v > 0));
    let low = axis.min ?? Math.min(...finite, axis.atMost ?? Infinity);
    let high = axis.max ?? Math.max(...finite, axis.atLeast ?? -Infinity);
    if (!Number.isFinite(low) || !Number.isFinite(high)) [low, high] = axis.log ? [0.1, 10] : [-1, 1];
    if (low === high) [low, high] = [low - 1, high + 1];
    const room = axis.log ? 0 : 0.04 * (high - low);
    return { ...axis, min: axis.min ?? low - room, max: axis.max ?? high + room };
  }

  // Widen the range of one axis, so that both have the same units per pixel in a plane of this ratio of width to height.
  function equalScales(x, y, ratio) {
    const missing = (x.max - x.min) / ratio - (y.max - y.min);
    const [axis, room] = missing > 0 ? [y, missing / 2] : [x, (-missing * ratio) / 2];
    axis.min -= room;
    axis.max += room;
  }

  function path(xs, ys, sx, sy) {
    let d = "";
    let down = false;
    for (let i = 0; i < xs.length; i++) {
      const y = sy(ys[i]);
      if (!Number.isFinite(y)) {
        down = false;
        continue;
      }
      d += `${down ? "L" : "M"}${sx(xs[i]).toFixed(1)} ${Math.max(-1e4, Math.min(1e4, y)).toFixed(1)}`;
      down = true;
    }
    return d;
  }

  // First index of each run of finite values, and the one after its last.
  function runs(values) {
    const pieces = [];
    values.forEach((v, i) => {
      if (!Number.isFinite(v)) return;
      if (i === 0 || !Number.isFinite(values[i - 1])) pieces.push([i, i + 1]);
      else pieces[pieces.length - 1][1] = i + 1;
    });
    return pieces;
  }

  // Symbols that are told apart without colour: circle, square, triangle, diamond, cross.
  function symbol(parent, kind, x, y, className) {
    const r = 5;
    const shapes = [
      null,
      `M${x - r} ${y - r}h${2 * r}v${2 * r}h${-2 * r}z`,
      `M${x} ${y - r}L${x + r} ${y + r}H${x - r}z`,
      `M${x} ${y - r}L${x + r} ${y}L${x} ${y + r}L${x - r} ${y}z`,
      `M${x - r} ${y - r}L${x + r} ${y + r}M${x + r} ${y - r}L${x - r} ${y + r}`,
    ];
    if (kind === 0) node(parent, "circle", { cx: x, cy: y, r, class: className });
    else node(parent, "path", { d: shapes[kind], class: className });
  }

  function legend(host, entries) {
    const list = document.createElement("ul");
    list.className = "legend";
    for (const { name, style, points, band } of entries) {
      const item = document.createElement("li");
      const swatch = node(item, "svg", { width: 30, height: 12, "aria-hidden": "true" });
      if (points) symbol(swatch, points.kind, 15, 6, `mark s${style}`);
      else if (band) node(swatch, "rect", { x: 1, y: 2, width: 28, height: 8, class: `band s${style}` });
      else node(swatch, "path", { d: "M1 6H29", class: `line s${style}` });
      item.appendChild(document.createTextNode(name));
      list.appendChild(item);
    }
    host.appendChild(list);
  }

  // Squares of a map, the first index along x: {edges: centres of rows and columns, values: [{level from 0 to 1, over}]}
  function squares(plane, { edges, values }, sx, sy) {
    const half = (edges[1] - edges[0]) / 2;
    const [width, height] = [sx(edges[1]) - sx(edges[0]), sy(edges[0]) - sy(edges[1])];
    values.forEach(({ level, over }, i) => {
      if (!Number.isFinite(level)) return;
      const [a, b] = [edges[Math.floor(i / edges.length)] - half, edges[i % edges.length] + half];
      node(plane, "rect", { x: sx(a), y: sy(b), width: width + 0.3, height: height + 0.3, class: "cell", "fill-opacity": 0.08 + 0.8 * level });
      if (over) node(plane, "path", { d: `M${sx(a)} ${sy(b) + height}l${width} ${-height}`, class: "hatch" });
    });
  }

  // spec: {title, x, y, height, series: [{name, style, x, y | low, high}], points: [{name, style, kind, x, y}], rays: [damping],
  //        cells: {edges, values, name}, pick(x, y): called with the place of a click,
  //        equal: whether both axes have one scale, used: [from, to] along x, outside of which the plane is shaded, drag(from, to): called with a dragged range of x}
  // An axis: {label, min, max, log, atLeast, atMost}; what is missing follows from the data.
  function draw(host, spec) {
    host.replaceChildren();
    const width = Math.max(260, Math.floor(host.clientWidth || 640));
    const height = spec.height ?? 260;
    const lines = spec.series ?? [];
    const points = spec.points ?? [];
    const all = [...lines, ...points];
    const xAxis = fitted(spec.x, all.flatMap((s) => Array.from(s.x)));
    const yAxis = fitted(spec.y, all.flatMap((s) => [...Array.from(s.y ?? []), ...Array.from(s.low ?? []), ...Array.from(s.high ?? [])]));
    const right = width - MARGIN.right;
    const bottom = height - MARGIN.bottom;
    if (spec.equal) equalScales(xAxis, yAxis, (right - MARGIN.left) / (bottom - MARGIN.top));
    const sx = scale(xAxis, MARGIN.left, right);
    const sy = scale(yAxis, bottom, MARGIN.top);
    legend(host, [...lines.map((s) => ({ ...s, points: null, band: Boolean(s.low) })), ...points.map((s) => ({ ...s, points: s }))]);
    const svg = node(host, "svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": spec.title });
    const clip = `clip-${host.id}`;
    node(node(node(svg, "defs"), "clipPath", { id: clip }), "rect", {
      x: MARGIN.left, y: MARGIN.top, width: right - MARGIN.left, height: bottom - MARGIN.top,
    });
    const xs = xAxis.log ? logTicks(xAxis.min, xAxis.max) : ticks(xAxis.min, xAxis.max, width / 95);
    const ys = yAxis.log ? logTicks(yAxis.min, yAxis.max) : ticks(yAxis.min, yAxis.max, height / 50);
    for (const v of xs) {
      node(svg, "path", { d: `M${sx(v)} ${MARGIN.top}V${bottom}`, class: "grid" });
      node(svg, "text", { x: sx(v), y: bottom + 16, "text-anchor": "middle" }, number(v));
    }
    for (const v of ys) {
      node(svg, "path", { d: `M${MARGIN.left} ${sy(v)}H${right}`, class: "grid" });
      node(svg, "text", { x: MARGIN.left - 6, y: sy(v) + 4, "text-anchor": "end" }, number(v));
    }
    const plane = node(svg, "g", { "clip-path": `url(#${clip})` });
    if (spec.cells) squares(plane, spec.cells, sx, sy);
    if (xAxis.zero) node(plane, "path", { d: `M${sx(0)} ${MARGIN.top}V${bottom}`, class: "zero" });
    for (const zeta of spec.rays ?? []) ray(svg, plane, zeta, xAxis, yAxis, sx, sy);
    for (const s of lines) {
      if (s.low) {
        for (const [first, last] of runs(s.low)) {
          const [x, low, high] = [s.x, s.low, s.high].map((values) => Array.from(values).slice(first, last));
          const back = path(x.reverse(), low.reverse(), sx, sy).replace("M", "L");
          node(plane, "path", { d: `${path(x.reverse(), high, sx, sy)}${back}z`, class: `band s${s.style}` });
        }
      } else node(plane, "path", { d: path(s.x, s.y, sx, sy), class: `line s${s.style}` });
    }
    for (const s of points) {
      for (let i = 0; i < s.x.length; i++) symbol(plane, s.kind, sx(s.x[i]), sy(s.y[i]), `mark s${s.style}`);
    }
    node(svg, "path", { d: `M${MARGIN.left} ${MARGIN.top}V${bottom}H${right}`, class: "axis" });
    node(svg, "text", { x: (MARGIN.left + right) / 2, y: height - 6, "text-anchor": "middle" }, xAxis.label);
    if (spec.cells) host.appendChild(Object.assign(document.createElement("p"), { className: "note", textContent: spec.cells.name }));
    if (spec.pick) {
      svg.addEventListener("click", (event) => {
        const box = svg.getBoundingClientRect();
        const along = (axis, place, from, to) => axis.min + ((place - from) / (to - from)) * (axis.max - axis.min);
        spec.pick(along(xAxis, event.clientX - box.left, MARGIN.left, right), along(yAxis, event.clientY - box.top, bottom, MARGIN.top));
      });
    }
    const part = (from, to, className) => {
      const [a, b] = [from, to].map((v) => Math.min(right, Math.max(MARGIN.left, v)));
      return node(svg, "rect", { x: a, y: MARGIN.top, width: Math.max(0, b - a), height: bottom - MARGIN.top, class: className });
    };
    if (spec.used) {
      part(MARGIN.left, sx(spec.used[0]), "unused");
      part(sx(spec.used[1]), right, "unused");
    }
    if (spec.drag) {
      const place = (event) => event.clientX - svg.getBoundingClientRect().left;
      const value = (x) => Math.min(xAxis.max, Math.max(xAxis.min, xAxis.min + ((x - MARGIN.left) / (right - MARGIN.left)) * (xAxis.max - xAxis.min)));
      svg.addEventListener("pointerdown", (down) => {
        const start = place(down);
        let shown = null;
        svg.setPointerCapture(down.pointerId);
        const range = (event) => [start, place(event)].sort((a, b) => a - b);
        svg.onpointermove = (event) => {
          shown?.remove();
          shown = part(...range(event), "dragged");
        };
        svg.onpointerup = (event) => {
          svg.onpointermove = svg.onpointerup = null;
          shown?.remove();
          const [a, b] = range(event);
          if (b - a > 4) spec.drag(value(a), value(b));
        };
      });
    }
    const middle = (MARGIN.top + bottom) / 2;
    node(svg, "text", { x: 13, y: middle, "text-anchor": "middle", transform: `rotate(-90 13 ${middle})` }, yAxis.label);
  }

  // A ray of equal damping in the upper left half of the plane, named where it leaves it.
  function ray(svg, plane, zeta, xAxis, yAxis, sx, sy) {
    const slope = Math.sqrt(1 - zeta * zeta) / zeta;
    const reach = Math.min(-xAxis.min, yAxis.max / slope);
    if (!(reach > 0)) return;
    node(plane, "path", { d: `M${sx(0)} ${sy(0)}L${sx(-reach)} ${sy(reach * slope)}`, class: "ray" });
    const atTop = reach < -xAxis.min;
    if (zeta < 0.1) return;
    const y = sy(reach * slope) + (atTop ? 12 : -4);
    node(svg, "text", { x: sx(-reach) + 3, y, "text-anchor": "start", class: "ray-name" }, String(zeta));
  }

  return { draw, number, curve };
})();
