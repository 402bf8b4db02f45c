// The fit selector: one fit at a time, its numbers and how it follows the recording, from the data in the page.
"use strict";

const Fits = (() => {
  let data = null;
  let root = null;

  const part = (name) => root.querySelector(`#fit-${name}`);
  const { curve } = Charts;

  function table({ columns, rows }) {
    const made = document.createElement("table");
    const row = (body, cells, kind) => {
      const tr = body.appendChild(document.createElement("tr"));
      cells.forEach((text, i) => {
        const cell = tr.appendChild(document.createElement(i === 0 ? "th" : kind));
        if (cell.tagName === "TH") cell.scope = kind === "th" ? "col" : "row";
        cell.className = columns[i][1] || (i === 0 && kind === "th") ? "left" : "";
        cell.textContent = text;
      });
    };
    row(made.createTHead(), columns.map(([heading]) => heading), "th");
    const body = made.createTBody();
    for (const cells of rows) row(body, cells, "td");
    made.setAttribute("aria-label", columns[0][0]);
    const host = Object.assign(document.createElement("div"), { className: "scroll", tabIndex: 0 });
    host.setAttribute("role", "region");
    host.setAttribute("aria-label", columns[0][0]);
    host.appendChild(made);
    return host;
  }

  function plot(host, trace, output) {
    const since = trace.times ? curve(trace.times) : Array.from({ length: output.n }, (_, i) => i * trace.step);
    const time = since.map((t) => 1e3 * (trace.start + t));
    const unit = output.unit;
    Charts.draw(host, {
      title: `${output.name}, measured and simulated, from ${Charts.number(trace.start)} s`,
      x: { label: `time [ms], ${trace.recording}`, min: time[0], max: time[time.length - 1] },
      y: { label: `${output.name} [${unit}]` },
      height: 220,
      series: [
        { name: "measured", style: 0, x: time, y: curve(output.measured) },
        { name: "simulated", style: 1, x: time, y: curve(output.simulated) },
      ],
    });
  }

  function residual(host, trace, output) {
    const n = output.error_n;
    const time = Array.from({ length: n }, (_, i) => ((i + 0.5) * trace.duration) / n);
    Charts.draw(host, {
      title: `${output.name}, range of measured minus simulated over the whole recording`,
      x: { label: "time [s], whole recording", min: 0, max: trace.duration },
      y: { label: `error [${output.unit}]` },
      height: 140,
      series: [{ name: `${output.name}: measured − simulated, smallest to largest`, style: 2, x: time, low: curve(output.error_low), high: curve(output.error_high) }],
    });
  }

  // Curves that are not in the page lie beside it, in a script for each fit.
  function load(name, host) {
    host.textContent = "The curves of this fit are beside the page and are being loaded.";
    const script = document.createElement("script");
    script.src = [data.beside, ...name.split("/").map(encodeURIComponent)].join("/") + ".js";
    script.onerror = () => {
      host.textContent =
        "The page has the curves of the worst and the best fits. The command “gbid report EXPERIMENT --curves” writes the others beside it, and “gbid serve EXPERIMENT” draws them on demand.";
    };
    document.head.appendChild(script);
  }

  function add(name, curves) {
    Object.assign(data.fits[name], curves);
    if (part("select").value === name) show(name, true);
  }

  function show(name, keepHash = false) {
    const fit = data.fits[name];
    if (!fit) return;
    part("select").value = name;
    part("title").textContent = fit.title;
    const status = part("status");
    status.textContent = fit.status;
    status.className = `verdict ${fit.state}`;
    part("tables").replaceChildren(...fit.tables.map(table));
    const facts = part("facts");
    facts.replaceChildren();
    for (const [word, text] of fit.facts) {
      facts.appendChild(Object.assign(document.createElement("dt"), { textContent: word }));
      facts.appendChild(Object.assign(document.createElement("dd"), { textContent: text }));
    }
    const curves = part("curves");
    curves.replaceChildren();
    (fit.traces ?? []).forEach((trace, k) =>
      trace.outputs.forEach((output, i) => {
        for (const [kind, drawn] of [["curve", plot], ["error", residual]]) {
          const host = document.createElement("div");
          host.id = `fit-${kind}-${k}-${i}`;
          host.className = "chart";
          curves.appendChild(host);
          drawn(host, trace, output);
        }
      }),
    );
    if (!fit.traces) load(name, curves);
    else if (!fit.traces.length) curves.textContent = fit.no_trace;
    const order = Object.keys(data.fits);
    const at = order.indexOf(name);
    part("previous").disabled = at === 0;
    part("next").disabled = at === order.length - 1;
    if (!keepHash) {
      try {
        history.replaceState(null, "", `#fit&${encodeURIComponent(name)}`);
      } catch {
        // some browsers refuse this for files; the page works without it
      }
    }
  }

  function step(by) {
    const order = Object.keys(data.fits);
    const next = order[order.indexOf(part("select").value) + by];
    if (next) show(next);
  }

  function fromHash() {
    const [word, name] = location.hash.slice(1).split("&");
    if (word !== "fit" || !name) return false;
    show(decodeURIComponent(name), true);
    root.scrollIntoView();
    return true;
  }

  function start() {
    const found = document.getElementById("fit-data");
    root = document.getElementById("fit");
    if (!found || !root) return;
    data = JSON.parse(found.textContent);
    root.hidden = false;
    part("select").addEventListener("change", (event) => show(event.target.value));
    part("previous").addEventListener("click", () => step(-1));
    part("next").addEventListener("click", () => step(1));
    if (!fromHash()) show(part("select").value, true);
    window.addEventListener("hashchange", fromHash);
    const again = () => show(part("select").value, true);
    window.addEventListener("resize", again);
    window.addEventListener("beforeprint", again);
  }

  return { start, add };
})();
