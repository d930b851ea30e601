"use strict";
// Charts of signals over time, by uPlot, on one time axis: they zoom together, share a cursor, and mark the clock's time.
//   createCharts(root, runs, clock, shown, height): colours stand for joints, or for runs where there are several.

const SIGNALS = {
  error: {chip: "|error|", title: "|error|", log: true, of: "position", parts: [["error", Math.abs]]},
  signed: {chip: "error", title: "error", of: "position", parts: [["error"]]},
  position: {chip: "position", title: "position", of: "position", parts: [["q"], ["q_ref", null, [6, 4]]], note: "dashed: reference"},
  velocity: {chip: "velocity", title: "velocity", of: "velocity", parts: [["v"], ["v_ref", null, [6, 4]]], note: "dashed: reference"},
  torque: {chip: "torque", title: "torque", of: "torque", parts: [["tau"]], note: "applied"},
  saturation: {chip: "saturation", title: "torque asked for", unit: "% of the limit", parts: [["share", (x) => 100 * x]], line: 100, note: "above 100 % it is cut"},
  disturbance: {chip: "disturbance", title: "disturbance", of: "torque", parts: [["disturbance"]]},
  external: {chip: "from outside", title: "torque from outside, by the momentum", of: "torque", parts: [["external"], ["disturbance", null, [6, 4]]], dashed: "simulated", note: "dashed: the simulated disturbance, if any"},
  estimates: {chip: "estimates", title: "learned", parts: [["estimates"]]},
  tip: {chip: "tip", title: "tip, distance from the reference", log: true, unit: "mm", parts: [["tip", (x) => 1000 * x]]},
};

function createCharts(root, runs, clock, shown, height) {
  const several = runs.length > 1;
  for (const run of runs) {
    const {signals} = run;
    run.columns = {times: decoded(signals.times, Float64Array)};
    run.column = (name, k) => {   // the numbers of one joint, or of one tip
      const width = name === "tip" ? signals.tips.length : run.joints.length;
      const all = run.columns[name] ??= decoded(signals[name], Float32Array);
      return Array.from(run.columns.times, (_, row) => all[row * width + k]);
    };
  }
  const joints = matched(runs.map((run) => run.joints.map((joint) => joint.name)));
  const tips = matched(runs.map((run) => run.signals.tips));
  const sizeOf = (k) => Math.max(...runs.map((run, r) => (joints[k].at[r] < 0 ? 0 : Math.hypot(...run.column("error", joints[k].at[r])))));
  const worst = () => joints.reduce((most, _, k) => (sizeOf(k) > sizeOf(most) ? k : most), 0);
  const chosen = new Set(several ? [worst()] : joints.map((_, k) => k));
  const panels = [...new Set(runs.flatMap((run) => run.signals.estimates.map(({title, unit}) => `${title} [${unit}]`)))];
  let tip = 0, panel = panels[0], plots = [], zooming = false;
  const there = {disturbance: runs.some((run) => run.signals.disturbed), estimates: panels.length > 0};
  const names = Object.keys(SIGNALS).filter((name) => there[name] ?? true);

  root.innerHTML = `<div class="chips signals" role="group" aria-label="signals"></div><div class="chips joints" role="group" aria-label="joints"></div><div class="plots"></div>`;
  const [signalChips, jointChips, place] = root.children;

  function chip(parent, text, colour, pressed, act) {
    const button = parent.appendChild(document.createElement("button"));
    if (colour) Object.assign(button.appendChild(document.createElement("span")), {className: "swatch"}).style.background = colour;
    button.append(text);
    button.type = "button";
    if (pressed !== null) button.setAttribute("aria-pressed", pressed);
    button.onclick = act;
    return button;
  }

  function dressChips() {
    signalChips.replaceChildren();
    for (const name of names) {
      chip(signalChips, SIGNALS[name].chip, "", shown.has(name), () => { if (!shown.delete(name)) shown.add(name); draw(); });
    }
    chip(signalChips, "+", "", null, () => zoom(.5)).title = "zoom in around the time of the arm (or drag over a chart)";
    chip(signalChips, "−", "", null, () => zoom(2)).title = "zoom out";
    chip(signalChips, "whole run", "", null, () => setRange(clock.start, clock.end)).title = "show all of the time (or double-click a chart)";
    jointChips.replaceChildren();
    if (several) {
      runs.forEach((run, k) => {
        const legend = jointChips.appendChild(document.createElement("span"));
        Object.assign(legend.appendChild(document.createElement("span")), {className: "swatch"}).style.background = colour(k);
        legend.append(run.label);
        legend.style.marginRight = "8px";
      });
    }
    const toggle = (k) => {
      if (several) { chosen.clear(); chosen.add(k); } else if (!chosen.delete(k)) chosen.add(k);
      draw();
    };
    joints.forEach((joint, k) => { chip(jointChips, joint.name, several ? "" : colour(k), chosen.has(k), () => toggle(k)); });
    if (joints.length > 2 && !several) {
      chip(jointChips, chosen.size ? "none" : "all", "", null, () => {
        if (chosen.size) chosen.clear(); else joints.forEach((_, k) => chosen.add(k));
        draw();
      });
    }
  }

  function zoom(factor) {
    const half = factor * (clock.to - clock.from) / 2, centre = clock.now;
    setRange(Math.max(clock.start, centre - half), Math.min(clock.end, centre + half));
  }
  function setRange(min, max) {
    if (!(max > min)) return;
    clock.window(min, max);
    zooming = true;
    for (const {plot} of plots) plot.setScale("x", {min: clock.from, max: clock.to});
    zooming = false;
  }

  function learnedLines(run, index) {   // the lines of the panel of estimates that is chosen, those of the chosen joints
    const of = run.signals.estimates.find(({title, unit}) => `${title} [${unit}]` === panel);
    if (!of) return [];
    const all = of.decoded ??= decoded(of.values, Float32Array), width = of.names.length;
    const placed = of.names.map((name) => (of.of_joints ? joints.findIndex(({at}) => at[index] >= 0 && run.joints[at[index]].name === name) : -1));
    return of.names.map((name, k) => ({
      label: several ? `${run.label}, ${name}` : name, aside: false, dash: name === "carried" && !of.of_joints ? [2, 3] : undefined,
      colour: several ? colour(index) : colour(of.of_joints ? placed[k] : k), unit: of.unit, width: 1.3,
      values: Array.from(run.columns.times, (_, row) => all[row * width + k]).map((x) => (Number.isNaN(x) ? null : x)),
    })).filter((_, k) => !of.of_joints || chosen.has(placed[k]));
  }

  function linesOf(signal, run, index) {   // label, colour, values and dashes of every line of a run
    if (signal === SIGNALS.estimates) return learnedLines(run, index);
    const all = signal.parts[0][0] === "tip" ? tips : joints, picked = all === tips ? [tip] : [...chosen].sort((a, b) => a - b);
    return picked.filter((k) => all[k].at[index] >= 0).flatMap((k) => signal.parts.filter(([name, , dash]) => !dash || name !== "disturbance" || run.signals.disturbed).map(([name, change, dash]) => ({
      label: several ? run.label : all[k].name, beside: signal.dashed ?? "reference", aside: Boolean(dash), dash: dash ?? (several && index > 9 ? [2, 2] : undefined),
      colour: several ? colour(index) : all === tips ? themed("--ink") : colour(k), unit: signal.unit ?? run.joints[all[k].at[index]][signal.of],
      values: run.column(name, all[k].at[index]).map((x) => (x = change ? change(x) : x, signal.log && !(x > 0) ? null : x)),
      width: dash ? 1 : 1.3,
    })));
  }

  function ranged(signal) {
    if (signal.log) {
      return (plot, least, most) => {
        if (!(most > 0)) return [1e-6, 1];
        const top = Math.ceil(Math.log10(most) - 1e-9), low = Math.max(Math.floor(Math.log10(least > 0 ? least : most)), top - 9);
        return [10 ** Math.min(low, top - 1), 10 ** top];
      };
    }
    return (plot, least, most) => {
      if (signal.line !== undefined) { least = 0; most = Math.max(most ?? 0, 1.1 * signal.line); }
      const pad = .06 * (most - least) || Math.abs(most) || 1;
      return [signal.line === undefined ? least - pad : 0, most + pad];
    };
  }

  function shade(plot) {   // the stretches in which a chosen joint was saturated
    const {ctx, bbox} = plot, colours = themed("--cut");
    const between = (t) => Math.min(bbox.left + bbox.width, Math.max(bbox.left, plot.valToPos(t, "x", true)));
    ctx.save();
    ctx.fillStyle = colours;
    for (const [r, run] of runs.entries()) {
      for (const k of chosen) {
        for (const [begin, end] of run.signals.saturated[joints[k].at[r]] ?? []) {
          const x = between(begin), wide = between(end) - x;
          if (end > plot.scales.x.min && begin < plot.scales.x.max) ctx.fillRect(x, bbox.top, Math.max(wide, 2 * devicePixelRatio), bbox.height);
        }
      }
    }
    ctx.restore();
  }

  function dot(plot) {   // the times at which the plant changes
    const {ctx, bbox} = plot;
    ctx.save();
    Object.assign(ctx, {strokeStyle: themed("--ink"), lineWidth: 1.2 * devicePixelRatio});
    ctx.setLineDash([1.5 * devicePixelRatio, 2.5 * devicePixelRatio]);
    for (const t of new Set(runs.flatMap((run) => run.signals.changes))) {
      if (t < plot.scales.x.min || t > plot.scales.x.max) continue;
      const x = plot.valToPos(t, "x", true);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
    }
    ctx.restore();
  }

  function drawChart(name) {
    const signal = SIGNALS[name], box = place.appendChild(document.createElement("div"));
    box.className = "chart";
    const tables = runs.map((run, index) => ({run, lines: linesOf(signal, run, index)}));
    const lines = tables.flatMap((table) => table.lines);
    const units = [...new Set(lines.map((line) => line.unit))].join(", ");
    const heading = box.appendChild(document.createElement("h3"));
    heading.textContent = `${signal.title}${units ? ` [${units}]` : ""}`;
    if (name === "tip" && tips.length > 1) heading.append(choice("tip", tips.map((one) => one.name), tip, (k) => { tip = k; }));
    if (name === "estimates") {
      heading.textContent = signal.title;   // the panels name their units
      heading.append(choice("what was learned", panels, panels.indexOf(panel), (k) => { panel = panels[k]; }));
    }
    const notes = [signal.note, runs.some((run) => run.signals.changes.length) && "dotted: the plant changes"].filter(Boolean);
    if (notes.length) heading.appendChild(document.createElement("span")).textContent = notes.join("; ");
    const data = uPlot.join(tables.map(({run, lines: own}) => [run.columns.times, ...own.map((line) => line.values)]));
    const hovered = {is: false, from: 0};
    const tooltip = document.createElement("div");
    tooltip.className = "tooltip";
    const axis = {stroke: themed("--soft"), grid: {stroke: themed("--grid"), width: 1}, ticks: {show: false}, font: "11px system-ui, sans-serif"};
    const plot = new uPlot({
      width: box.clientWidth || 600, height, padding: [8, 16, 0, 0], legend: {show: false}, pxAlign: false,
      cursor: {sync: {key: "time", setSeries: false, scales: ["x", null]}, y: false, drag: {x: true, y: false}, points: {size: 5}},
      scales: {x: {time: false, range: (p, a, b) => (a === null || !zooming && a === b ? [clock.from, clock.to] : [a, b])},
        y: {distr: signal.log ? 3 : 1, range: ranged(signal)}},
      axes: [
        {...axis, size: 26, values: (p, at) => at.map((t) => `${+t.toPrecision(6)} s`)},
        {...axis, size: 62, space: 24, ...(signal.log ? {splits: (p, i, low, high) => powers(low, high), filter: (p, at) => at} : {}), values: (p, at) => at.map((y) => (signal.log ? tenth(y) : told3(y)))},
      ],
      series: [{}, ...lines.map((line) => ({label: line.label, stroke: line.colour, width: line.width, dash: line.dash, points: {show: false}}))],
      hooks: {
        drawClear: [shade],
        draw: [dot, (p) => {
          if (signal.line === undefined) return;
          const y = p.valToPos(signal.line, "y", true);
          Object.assign(p.ctx, {strokeStyle: themed("--soft"), lineWidth: devicePixelRatio});
          p.ctx.setLineDash([6, 4]);
          p.ctx.beginPath(); p.ctx.moveTo(p.bbox.left, y); p.ctx.lineTo(p.bbox.left + p.bbox.width, y); p.ctx.stroke();
          p.ctx.setLineDash([]);
        }],
        setScale: [(p, key) => {
          const {min, max} = p.scales[key];
          if (key === "x" && !zooming && plots.length && (min !== clock.from || max !== clock.to)) setRange(min, max);
        }],
        setCursor: [(p) => tell(p, lines, tooltip, hovered.is)],
      },
    }, data, box);
    const marker = plot.over.appendChild(document.createElement("div"));
    marker.className = "marker";
    plot.over.append(tooltip);
    tooltip.hidden = true;
    plot.over.addEventListener("mouseenter", () => { hovered.is = true; });
    plot.over.addEventListener("mouseleave", () => { hovered.is = false; tooltip.hidden = true; });
    plot.over.addEventListener("mousedown", (event) => { hovered.from = event.clientX; });
    plot.over.addEventListener("click", (event) => {
      if (Math.abs(event.clientX - hovered.from) > 4) return;
      clock.pause();
      clock.seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    });
    plots.push({plot, marker, box});
  }

  function choice(what, options, chosenOne, choose) {
    const select = document.createElement("select");
    options.forEach((text, k) => select.add(new Option(text, k, k === chosenOne, k === chosenOne)));
    select.setAttribute("aria-label", what);
    select.onchange = () => { choose(Number(select.value)); draw(); };
    return select;
  }

  function tell(plot, lines, tooltip, isHovered) {   // the values at the cursor
    const {idx, left, top} = plot.cursor;
    tooltip.hidden = !isHovered || idx === null || idx === undefined || left < 0;
    if (tooltip.hidden) return;
    const rows = [`t = ${plot.data[0][idx].toFixed(3)} s`];
    tooltip.replaceChildren(rows[0]);
    lines.forEach((line, k) => {
      let at = idx;   // of runs with other times, the last value before
      while (at > 0 && plot.data[k + 1][at] === undefined) at -= 1;
      const value = plot.data[k + 1][at];
      if (value === null || value === undefined || line.aside && several) return;
      const row = tooltip.appendChild(document.createElement("div"));
      Object.assign(row.appendChild(document.createElement("span")), {className: "swatch"}).style.background = line.colour;
      row.append(line.label + (line.aside ? ` (${line.beside})` : ""));
      const also = beside(value, line.unit);
      row.appendChild(document.createElement("span")).textContent = `${told(value)} ${line.unit}${also ? ` (${also})` : ""}`;
    });
    const wide = tooltip.offsetWidth, right = left + 14 + wide > plot.over.clientWidth;
    tooltip.style.left = `${right ? Math.max(0, left - wide - 14) : left + 14}px`;
    tooltip.style.top = `${Math.min(top + 12, Math.max(0, plot.over.clientHeight - tooltip.offsetHeight))}px`;
  }

  function mark() {
    for (const {plot, marker} of plots) {
      const {min, max} = plot.scales.x, inside = clock.now >= min && clock.now <= max;
      marker.style.display = inside ? "" : "none";
      if (inside) marker.style.left = `${plot.valToPos(clock.now, "x")}px`;
    }
  }

  function draw() {
    dressChips();
    plots.forEach(({plot}) => plot.destroy());
    plots = [];
    place.replaceChildren();
    const range = [clock.from, clock.to];
    for (const name of names) if (shown.has(name)) drawChart(name);
    setRange(...range);
    mark();
  }
  clock.on(mark);
  onTheme(draw);
  new ResizeObserver(() => {
    for (const {plot, box} of plots) if (box.clientWidth && box.clientWidth !== plot.width) plot.setSize({width: box.clientWidth, height});
    mark();
  }).observe(root);
  draw();
  return {draw, setTip(k) { tip = k; draw(); }, get plots() { return plots.map(({plot}) => plot); }};
}

// What several runs call their joints or tips, and where each run has it (−1: nowhere): by name where all runs have the same
// names, in whatever order, and by place in arms that differ.
function matched(lists) {
  const [first] = lists, alike = lists.every((names) => names.length === first.length && first.every((name) => names.includes(name)));
  return Array.from({length: Math.max(...lists.map((names) => names.length))}, (_, k) => ({
    name: [...new Set(alike ? [first[k]] : lists.flatMap((names) => names[k] ?? []))].join(" / "),
    at: lists.map((names) => (alike ? names.indexOf(first[k]) : k < names.length ? k : -1)),
  }));
}

function powers(low, high) {   // of ten, at most five of them
  const first = Math.round(Math.log10(low)), last = Math.round(Math.log10(high)), every = Math.ceil((last - first) / 4) || 1;
  return Array.from({length: Math.floor((last - first) / every) + 1}, (_, k) => 10 ** (last - k * every)).reverse();
}
function tenth(value) {
  const power = Math.round(Math.log10(value));
  return power > -2 && power < 4 ? String(+value.toPrecision(3)) : `1e${power}`;
}
function told3(value) {
  const text = Math.abs(value) >= 1e5 || value !== 0 && Math.abs(value) < 1e-4 ? value.toExponential(1) : String(+value.toPrecision(4));
  return text.replace(/^-/, "−");
}
