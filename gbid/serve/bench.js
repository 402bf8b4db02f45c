// The page of `gbid open`: shows a folder of recordings, and writes each choice into the YAML of the experiment.
"use strict";

(() => {
  const EVERY = 2000; // between two looks at the folder [ms]
  const LARGE = 3e7; // bytes: a larger file is read when it is chosen
  const ROLES = ["r", "u", "p", "phi"];
  const at = (id) => document.getElementById(id);
  const about = JSON.parse(at("about").textContent);
  const state = { files: {}, file: "", shown: null, text: "", saved: "", dirty: false, marks: {}, answers: {}, asking: 0, was: null };

  const make = (tag, more = {}, ...children) => {
    const made = Object.assign(document.createElement(tag), more);
    made.append(...children);
    return made;
  };
  const items = (id, texts, around = (text) => [text]) => at(id).replaceChildren(...texts.map((text) => make("li", {}, ...around(text))));
  const fault = (text) => {
    at("page-errors").hidden = !text;
    items("page-errors", text ? text.split("\n") : []);
  };

  async function ask(name, document, signal = null) {
    const more = document && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(document), signal };
    let answer;
    try {
      answer = await fetch(name, more);
    } catch {
      throw new Error("The server does not answer. Start gbid open again; what is saved is in the experiment's YAML.");
    }
    const text = await answer.text();
    if (!answer.ok) throw new Error(text);
    return JSON.parse(text);
  }

  // Runs what a user has asked for, and shows its error.
  const act = (work) => async (...given) => {
    try {
      fault("");
      await work(...given);
    } catch (error) {
      fault(error.message);
    }
  };

  // ---- Files of the folder.

  async function look() {
    try {
      const now = await ask("now");
      if (at("page-errors").textContent.startsWith("The server does not")) fault("");
      const before = state.files;
      state.files = now.files;
      if (now.saved !== state.saved && state.dirty) at("told").textContent = "The file of the experiment has changed on the disk: load it anew, or save over it.";
      else if (now.saved !== state.saved) await take(now.text, now.saved);
      showRun(now.run);
      const names = Object.keys(now.files);
      if (JSON.stringify(before) !== JSON.stringify(now.files)) showFiles();
      if (!state.file && names.length) await choose(names[0]);
      else if (state.file && JSON.stringify(before[state.file]) !== JSON.stringify(now.files[state.file])) await choose(state.file);
      markNext();
    } catch (error) {
      fault(error.message);
    }
    setTimeout(look, EVERY);
  }

  const markKey = (name) => JSON.stringify([state.files[name], state.text]);

  function showFiles() {
    const gone = state.file && !(state.file in state.files) ? [state.file] : [];
    at("files").replaceChildren(
      ...[...Object.keys(state.files), ...gone].map((name) => {
        const { faults = [], remarks = [] } = gone.includes(name) ? { faults: ["no longer there"] } : state.marks[name] ?? {};
        const button = make("button", { type: "button", onclick: act(() => choose(name)) }, name);
        if (name === state.file) button.setAttribute("aria-current", "true");
        for (const text of faults) button.append(make("small", { className: "fault" }, `✗ ${short(text, name)}`));
        for (const text of remarks) button.append(make("small", {}, short(text, name)));
        return make("li", {}, button);
      }),
    );
  }

  // A message without the path and the name of its file, cut to the length of a mark.
  const short = (text, name) => {
    const words = text.slice(text.includes(`${name}: `) ? text.indexOf(`${name}: `) + name.length + 2 : 0).replace(/^recording '[^']*':? /, "");
    return words.length > 90 ? `${words.slice(0, 88)} …` : words;
  };

  const marksOf = (shown) => ({ faults: [shown.fault, ...shown.problems].filter(Boolean), remarks: shown.remarks });

  async function plotsOf(name) {
    const key = markKey(name);
    try {
      const shown = await ask("plots", { file: name, text: state.text });
      state.marks[name] = { key, ...marksOf(shown) };
      return shown;
    } catch (error) {
      state.marks[name] = { key, faults: [error.message], remarks: [] };
      throw error;
    }
  }

  // Reads the files one after the other, in order to mark them.
  let marking = false;
  async function markNext() {
    if (marking) return;
    marking = true;
    for (const name of Object.keys(state.files)) {
      if (state.files[name]?.[0] > LARGE || state.marks[name]?.key === markKey(name)) continue;
      await plotsOf(name).catch(() => {});
      showFiles();
    }
    marking = false;
  }

  async function choose(name) {
    state.file = name;
    showFiles();
    const mine = ++state.asking;
    try {
      const shown = await plotsOf(name);
      if (mine !== state.asking) return;
      state.shown = shown;
      showPlots();
      showChoices();
    } catch (error) {
      if (mine !== state.asking) return;
      for (const id of ["mapped", "others", "orbit", "speed"]) at(id).replaceChildren();
      items("problems", [error.message]);
    }
    showFiles();
  }

  // ---- Plots.

  function showPlots() {
    const shown = state.shown;
    const section = shown.section ?? {};
    at("plots-title").textContent = `Plots of ${state.file}`;
    items("problems", [...marksOf(shown).faults, ...shown.remarks]);
    const dt = shown.sample_time;
    const end = shown.n_samples * dt;
    const x = { label: shown.timed ? "time [s]" : "sample", min: 0, max: end };
    const used = section.from_s || section.to_s ? [section.from_s ?? 0, section.to_s ?? end] : null;
    const drag = (from, to) => setCut(from <= 0.002 * end ? null : rounded(from), to >= 0.998 * end ? null : rounded(to));
    const groups = new Map();
    const role = Object.fromEntries(shown.channels.map((c) => [c.name, c.role]));
    for (const line of shown.lines) {
      const isMapped = /^[^.]+\.[^.]+$/.test(line.name) && line.name.split(".")[0] in (section.signals ?? {});
      const group = isMapped ? line.name.split(".")[0] : role[line.name] ? role[line.name].split(" ")[0] : `column ${line.name}`;
      groups.set(group, [...(groups.get(group) ?? []), line]);
    }
    const order = [...groups.keys()].sort((a, b) => (ROLES.indexOf(a) + 9) % 9 - (ROLES.indexOf(b) + 9) % 9);
    at("mapped").replaceChildren();
    at("others").replaceChildren();
    const charts = []; // drawn when all have their places
    const chart = (host, title, spec) => charts.push([placed(host, title), { title: `${title} of ${state.file}`, height: 200, ...spec }]);
    for (const group of order) {
      const lines = groups.get(group);
      const host = group.startsWith("column ") ? "others" : "mapped";
      const units = [...new Set(lines.map((l) => shownIn(l.unit)[0]))].join(", ");
      chart(host, about.names[group] ?? group, {
        x, y: { label: `${group.replace("column ", "")} [${units}]` }, used, drag: shown.timed ? drag : null,
        series: lines.map((line, style) => ({
          name: line.name, style, x: line.low.flatMap((_, k) => [(k + 0.25) / line.low.length * end, (k + 0.75) / line.low.length * end]),
          y: line.low.flatMap((low, k) => [low, line.high[k]].map((v) => (v ?? NaN) * shownIn(line.unit)[1])),
        })),
      });
      if (host === "mapped") {
        const spectra = shown.spectra.filter((s) => lines.some((l) => l.name === s.name));
        chart("others", `Spectrum of ${group}`, {
          x: { label: shown.timed ? "frequency [Hz]" : "frequency [1/sample]", min: 0, max: 0.5 / dt }, y: { label: `amplitude [${units}]`, log: true },
          series: spectra.map(({ name, y }, style) => ({
            name, style, x: y.map((_, k) => (k + 0.5) / y.length * 0.5 / dt), y: y.map((v) => (v || NaN) * shownIn(lines[style].unit)[1]),
          })),
        });
      }
    }
    for (const each of charts) Charts.draw(...each);
    const [unit, factor] = shownIn(shown.orbit?.unit);
    const orbit = shown.orbit && {
      equal: true, x: { label: `x [${unit}]` }, y: { label: `y [${unit}]` },
      series: [{ name: "p, its last 1500 samples", style: 0, x: shown.orbit.x.map((v) => v * factor), y: shown.orbit.y.map((v) => v * factor) }],
    };
    draw("orbit", "Orbit", orbit, "There are no two columns of p.");
    const turns = shown.speed_rpm;
    const speed = turns.length && { x, y: { label: "speed [rpm]" }, used, series: [{ name: "from phi", style: 0, x: turns.map((_, k) => (k + 0.5) / turns.length * end), y: turns }] };
    draw("speed", "Speed", speed, "There is no shaft angle yet, or the shaft does not turn.");
    document.body.dataset.shown = state.file;
  }

  function placed(host, title) {
    const place = make("div", { className: "chart", id: `${host}-${at(host).children.length}` });
    at(host).append(make("div", {}, make("h3", {}, title), place));
    return place;
  }

  function draw(id, title, spec, otherwise) {
    if (spec) Charts.draw(at(id), { title: `${title} of ${state.file}`, height: 260, ...spec });
    else at(id).replaceChildren(make("p", { className: "note" }, otherwise));
  }

  // Unit and factor of an axis: metres are too large for it.
  const shownIn = (unit) => (unit === "m" ? ["µm", 1e6] : [unit || "number", 1]);

  const rounded = (value) => Number(value.toPrecision(4));

  // ---- Choices: before the draft they are answers, as to `gbid init`; then each is a value of the YAML.

  // Changes follow one another: each starts from the text that the one before has made.
  let changes = Promise.resolve();
  function set(key, value, ofFile = true) {
    const change = async () => {
      const changed = await ask("change", { text: state.text, file: ofFile ? state.file : "", key, value });
      await take(changed.text);
      at("told").textContent = `${key.join(".")} is set${ofFile ? " for all files with the same mapping" : ""}.`;
    };
    changes = changes.catch(() => {}).then(change);
    return changes;
  }

  const setCut = act(async (from, to) => {
    if (!state.text) return void (at("told").textContent = "Draft the experiment first; then a drag keeps a part.");
    await set(["from_s"], from);
    await set(["to_s"], to);
  });

  // A field with a label; `change` gets the text or the state of the box.
  function field(label, value, change, { options = null, type = "text", list = null } = {}) {
    const id = `f-${label.replace(/\W+/g, "-")}`;
    const input = options ? make("select", { id }, ...options.map((o) => make("option", { value: o, selected: o === value }, o || "–"))) : make("input", { id, type });
    if (list) input.setAttribute("list", list);
    if (type === "checkbox") input.checked = Boolean(value);
    else if (!options) input.value = value ?? "";
    input.addEventListener("change", act(() => change(type === "checkbox" ? input.checked : input.value.trim())));
    return make("div", { className: "field" }, make("label", { htmlFor: id }, label), input);
  }

  const number = (text) => {
    if (text === "") return null;
    const value = Number(text.replace(",", "."));
    if (!Number.isFinite(value)) throw new Error(`expected a number, found ${text}`);
    return value;
  };

  // Calibration of one column as text "0:0 10:125", and back.
  const sheetText = (points) => (points ?? []).map((pair) => pair.join(":")).join(" ");
  const sheet = (text) => (text ? text.split(/\s+/).map((pair) => pair.split(":").map(number)) : null);

  function showChoices() {
    const { channels, section } = state.shown;
    const columns = ["", ...channels.map((c) => c.name)];
    const found = (role) => channels.filter((c) => c.role.split(" ")[0] === role).sort((a, b) => (a.role < b.role ? -1 : 1)).map((c) => c.name);
    at("scope").textContent = section
      ? `Of ${state.file} and all files with the same mapping. Each choice is written into the experiment below.`
      : state.text ? `${state.file} is not in the experiment.` : "What the names of the columns tell is filled in. Correct it, then draft the experiment.";
    const answer = (key, text) => (text ? (state.answers[key] = text) : delete state.answers[key]);
    const hosts = [...new Set([...ROLES, ...Object.keys(section?.signals ?? {})])].map((role) => {
      const signal = section?.signals?.[role] ?? {};
      const given = state.answers[role]?.[1]?.split(",");
      const names = section ? signal.columns ?? [] : given ?? found(role);
      const axes = role === "phi" ? [""] : names.length > 2 ? names.map((_, k) => ` ${k + 1}`) : [" x", " y"];
      const why = channels.filter((c) => names.includes(c.name)).map((c) => c.why).join("; ");
      const box = make("fieldset", { className: "signal" }, make("legend", {}, `${role}: ${about.names[role] ?? "signal"}${why && !section ? ` (${why})` : ""}`));
      axes.forEach((axis, k) => box.append(field(`${role}${axis} is column`, names[k] ?? "", async (column) => {
        const next = axes.map((_, j) => (j === k ? column : names[j] ?? ""));
        names.splice(0, names.length, ...next);
        if (section && next.every((name) => !name)) await set(["signals", role], null);
        else if (next.every(Boolean) && section) await set(["signals", role, "columns"], next);
        else if (!section) answer(role, next.every(Boolean) || next.every((name) => !name) ? [role, next.filter(Boolean).join(",")] : null);
      }, { options: columns })));
      box.append(field(`unit of ${role}`, section ? signal.unit : state.answers[`unit ${role}`]?.[1].split("=")[1] ?? "", (unit) =>
        section ? set(["signals", role, "unit"], unit || null) : answer(`unit ${role}`, unit && ["unit", `${role}=${unit}`]), { list: "units" }));
      const sheets = [signal.calibration ?? []].flat();
      axes.forEach((axis, k) => box.append(field(`calibration of ${role}${axis}, as 0:0 10:125`, sheetText((sheets[k] ?? sheets[0])?.points) || state.answers[`sheet ${role} ${k}`]?.[2] || "", (text) => {
        const unit = at(`f-unit-of-${role}`).value || "um";
        if (!section) return void answer(`sheet ${role} ${k}`, text && ["calibration", `${names[k]}=${text} ${unit}`, text]);
        const points = axes.map((_, j) => (j === k ? sheet(text) : (sheets[j] ?? sheets[0])?.points) ?? [[0, 0], [1, 1]]);
        return set(["signals", role, "calibration"], text ? points.map((p) => ({ points: p })) : null);
      })));
      if (section) {
        for (const key of ["scale", "offset"]) box.append(field(`${key} of ${role}`, [signal[key] ?? ""].flat().join(" "), (text) => {
          const values = text.split(/\s+/).map(number);
          return set(["signals", role, key], values.length > 1 ? values : values[0]);
        }));
        box.append(field(`hold missing samples of ${role}`, signal.hold, (on) => set(["signals", role, "hold"], on || null), { type: "checkbox" }));
      }
      return box;
    });
    at("signals").replaceChildren(...hosts);
    const simple = (label, key, read = number, more = {}) => field(label, _at(section, key), (text) => set(key, read(text)), more);
    const word = (text) => text || null;
    const kinds = Object.entries(section?.kinds ?? {}).map((pair) => pair.join("=")).join(", ");
    const isFolder = section?.location[1] === "folder";
    const before = (label, key) => field(label, state.answers[key]?.[1] ?? "", (text) => answer(key, text && [key, text]));
    at("part").replaceChildren(...(section
      ? [
          simple("time column", ["time"], word, { options: columns }), simple("time between samples [s]", ["sample_time_s"]),
          simple("from [s]", ["from_s"]), simple("to [s]", ["to_s"]),
          simple("pressure [bar], unless the name tells it", ["conditions", "pressure_bar"]), simple("speed [rpm], unless the name tells it", ["conditions", "speed_rpm"]),
          ...(isFolder ? [simple("pattern of the file names", ["pattern"], word), field("kinds by word in the name", kinds, (text) =>
            set(["kinds"], text ? Object.fromEntries(text.split(",").map((pair) => pair.trim().split("="))) : null))]
            : [simple("kind", ["kind"], word, { options: about.kinds })]),
        ]
      : [before("pressure of all files [bar]", "pressure_bar"), before("speed of all files [rpm]", "speed_rpm"), before("pattern of the file names", "pattern"), before("structure of the controller", "controller")]));
    const machine = (label, key, factor) => field(label, state.shown.machine[key] && rounded(state.shown.machine[key] / factor), (text) =>
      set(["machine", key], number(text) && Number((factor * number(text)).toPrecision(12)), false));
    at("all").replaceChildren(...(state.text ? [machine("moving mass [kg]", "moving_mass_kg", 1), machine("travel of a piezo stack [µm]", "piezo_travel_m", 1e-6), machine("radial clearance [µm]", "clearance_m", 1e-6)] : []));
  }

  const _at = (value, keys) => keys.reduce((part, key) => part?.[key], value);

  const draft = act(async () => {
    at("draft").disabled = true;
    at("told").textContent = "Reading all files …";
    try {
      const made = await ask("draft", { answers: Object.values(state.answers).map((a) => a.slice(0, 2)), skip_broken: at("skip").checked });
      at("questions").hidden = !made.open;
      at("told").textContent = made.open ? "Some questions are open." : "Drafted. It is not saved yet.";
      items("notes", made.notes ?? []);
      if (!made.open) return void (await take(made.text));
      at("asked").replaceChildren(...Object.entries(made.open).map(([option, why]) =>
        make("div", {}, make("p", {}, why), field(`${option}: ${about.questions[option]}`, "", (text) => {
          if (text) state.answers[`asked ${option}`] = [option, text];
          else delete state.answers[`asked ${option}`];
        }))));
      at("asked").querySelector("input")?.focus();
    } finally {
      at("draft").disabled = false;
    }
  });

  // ---- Experiment: its text, what `gbid check` says, saving.

  async function take(text, saved = null) {
    state.text = text;
    state.dirty = saved === null;
    if (saved !== null) state.saved = saved;
    if (at("text").value !== text) at("text").value = text;
    at("save").disabled = !state.dirty;
    at("draft").textContent = text ? "Draft the experiment anew" : "Draft the experiment";
    if (state.file) await choose(state.file);
    check();
    markNext();
  }

  const REST = 800; // after a change, before the signals of all files are read [ms]
  let checking = new AbortController();
  async function check() {
    checking.abort(); // a browser opens few connections to a server
    const { signal } = (checking = new AbortController());
    if (!state.text) return;
    for (const quick of [true, false]) {
      if (!quick) await new Promise((done) => setTimeout(done, REST));
      if (signal.aborted) return;
      at("verdict").className = "verdict";
      if (quick) at("verdict").textContent = "Checking …";
      const said = await ask("check", { text: state.text, quick }, signal).catch((error) => ({ problems: [error.message], code: 1 }));
      if (signal.aborted) return;
      const good = !said.problems.length;
      at("verdict").textContent = good ? `nothing wrong: ${said.recordings} recordings, ${said.fits} fits${quick ? "; looking at the signals …" : ""}` : `${said.problems.length} problems`;
      at("verdict").className = `verdict ${good ? (quick ? "" : "good") : "bad"}`;
      items("faults", said.problems, linked);
      if (!good) return;
    }
  }

  // A message with a button for each file, and for the line of the YAML, that it names.
  function linked(text) {
    const named = Object.keys(state.files).filter((name) => text.includes(name) || text.includes(`'${name.replace(/\.\w+$/, "")}'`));
    const line = /\.yaml:(\d+):/.exec(text)?.[1];
    const buttons = named.slice(0, 3).map((name) => make("button", { type: "button", className: "link", onclick: act(() => choose(name)) }, `show ${name}`));
    if (line) buttons.push(make("button", { type: "button", className: "link", onclick: () => toLine(Number(line)) }, `line ${line}`));
    return [text, " ", ...buttons.flatMap((button) => [button, " "])];
  }

  function toLine(line) {
    const lines = state.text.split("\n");
    const start = lines.slice(0, line - 1).join("\n").length + (line > 1);
    at("text").focus();
    at("text").setSelectionRange(start, start + (lines[line - 1] ?? "").length);
    at("text").scrollTop = Math.max(0, (line - 6) * (at("text").scrollHeight / lines.length));
  }

  async function save() {
    const { saved } = await ask("save", { text: state.text, saved: state.saved });
    Object.assign(state, { saved, dirty: false });
    at("save").disabled = true;
    at("told").textContent = "Saved.";
  }

  // ---- Run and export.

  async function showRun(run) {
    at("run").disabled = run.running;
    at("cancel").disabled = !run.running;
    at("said").hidden = !run.said;
    if (at("said").textContent !== run.said) {
      at("said").textContent = run.said;
      at("said").scrollTop = at("said").scrollHeight;
    }
    if (!state.saved || (!run.running && state.was === `${run.code} ${state.saved}`)) return;
    state.was = `${run.code} ${state.saved}`;
    const seen = await ask("state").catch(() => null);
    if (!seen) return;
    const parts = Object.entries(seen.stages).map(([stage, count]) => `${stage} ${count.kept ?? 0} of ${Object.values(count).reduce((a, b) => a + b, 0)}${count.failed ? `, ${count.failed} failed` : ""}`);
    const begun = Object.values(seen.stages).some((count) => count.kept);
    at("progress").textContent = `${run.running ? "Running" : run.code === null ? "" : run.code === 0 ? "Done" : `Ended with code ${run.code}`} ${parts.join("; ")}`.trim();
    at("links").hidden = !begun;
    at("run").textContent = begun && run.code !== 0 ? "Save and resume" : "Save and run";
  }

  at("draft").addEventListener("click", draft);
  at("save").addEventListener("click", act(save));
  at("again").addEventListener("click", act(async () => {
    const now = await ask("now");
    await take(now.text, now.saved);
  }));
  at("text").addEventListener("change", act(() => take(at("text").value)));
  at("run").addEventListener("click", act(async () => {
    if (state.dirty) await save();
    state.was = null;
    await showRun(await ask("run", {}));
  }));
  at("cancel").addEventListener("click", act(async () => showRun(await ask("cancel", {}))));
  at("export").addEventListener("click", act(async () => {
    at("told").textContent = "Exporting …";
    const made = await ask("export", {});
    items("exported", [...made.said, ...made.files]);
    at("told").textContent = "Exported.";
  }));
  at("more").addEventListener("toggle", () => state.shown && showPlots());
  window.addEventListener("error", (event) => fault(event.message));
  window.addEventListener("beforeunload", (event) => state.dirty && event.preventDefault());
  look();
})();
