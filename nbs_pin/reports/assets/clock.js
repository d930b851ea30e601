"use strict";
// The one time of the page: charts, arms and the bar follow it and set it.

function createClock(start, end) {
  const told = [];
  let now = start, playing = false, last = 0, from = start, to = end;
  const tell = () => told.forEach((listener) => listener(now));
  const clock = {
    start, end, speed: 1,
    atEnd: null,   // called in place of beginning again, once
    get now() { return now; },
    get playing() { return playing; },
    get from() { return from; },
    get to() { return to; },
    on(listener) { told.push(listener); },
    seek(time) { now = Math.min(end, Math.max(start, time)); tell(); },
    play() { playing = end > start; tell(); },
    pause() { playing = false; tell(); },
    toggle() { if (playing) clock.pause(); else clock.play(); },
    window(a, b) { from = Math.max(start, a); to = Math.min(end, b); tell(); },   // what the charts show; it is played again and again
  };
  function tick(stamp) {
    if (playing) {
      now += clock.speed * Math.min(.1, (stamp - last) / 1000);
      if (now < from) now = from;
      if (now > to) {
        const {atEnd} = clock;
        now = atEnd ? to : from;
        if (atEnd) { playing = false; clock.atEnd = null; }
        tell();
        if (atEnd) atEnd();
      } else {
        tell();
      }
    }
    last = stamp;
    requestAnimationFrame(tick);
  }
  requestAnimationFrame(tick);
  return clock;
}

// Play button, speed, time and slider; the slider spans what the charts show. `step(n)` is the time n frames further.
function createBar(root, clock, step, keys = {}) {
  root.innerHTML = `<div class="controls"><button id="play" class="main" title="play or pause (space)" aria-label="play or pause"></button>
    <select id="speed" title="speed" aria-label="speed"></select><span id="label" class="time"></span></div>
    <input id="time" class="slider" type="range" step="any" aria-label="time">`;
  const at = (id) => root.querySelector(`#${id}`);
  const play = at("play"), speed = at("speed"), label = at("label"), slider = at("time");
  for (const factor of [.1, .25, .5, 1, 2, 5, 10]) speed.add(new Option(`${factor}×`, factor, factor === 1, factor === 1));
  play.onclick = () => clock.toggle();
  speed.onchange = (event) => { clock.speed = Number(event.target.value); event.target.blur(); };
  slider.oninput = (event) => {
    const time = Number(event.target.value);   // before the clock tells the slider where it is
    clock.pause();
    clock.seek(time);
  };
  clock.on((now) => {
    play.textContent = clock.playing ? "❚❚" : "▶";
    Object.assign(slider, {min: clock.from, max: clock.to, value: now});
    label.textContent = `${now.toFixed(2)} / ${clock.end.toFixed(2)} s`;
  });
  addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const on = event.target, typed = on.isContentEditable || /^(SELECT|TEXTAREA)$/.test(on.tagName);
    if (typed || on.tagName === "INPUT" && !/^(range|checkbox)$/.test(on.type)) return;
    // Space presses what has the focus, and Home and End scroll a page that is longer than the window.
    const pressed = /^(BUTTON|SUMMARY|A)$/.test(on.tagName) || on.type === "checkbox";
    const scrolls = on !== slider && document.documentElement.scrollHeight > innerHeight;
    const moves = {ArrowLeft: () => step(-1), ArrowRight: () => step(1), ...(scrolls ? {} : {Home: () => clock.start, End: () => clock.end})};
    if (event.key === " " && !pressed) { event.preventDefault(); clock.toggle(); }
    if (moves[event.key]) { event.preventDefault(); clock.pause(); clock.seek(moves[event.key]()); }
    if (keys[event.key]) keys[event.key]();
  });
  return root.querySelector(".controls");
}

// --- numbers and files

const DEGREES = 180 / Math.PI;
const decoded = (text, Kind) => new Kind(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);

function lastBefore(times, time) {   // where the last of the increasing times that is not after `time` stands
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= time + 1e-9) low = middle; else high = middle - 1;
  }
  return low;
}

function told(value) {   // about four digits, as 1.3e-6 rather than 0.0000013, with a true minus
  const size = Math.abs(value), digits = size < .01 ? 5 : size < 1 ? 4 : size < 10 ? 3 : size < 100 ? 2 : 1;
  const text = size === 0 ? "0" : size < 1e-3 || size >= 1e5 ? value.toExponential(1) : value.toFixed(digits);
  return text.replace(/^-/, "−");
}

function beside(value, unit) {   // the number in the unit that one reads: degrees, or millimetres
  if (unit === "rad") return `${told(value * DEGREES)}°`;
  if (unit === "rad/s") return `${told(value * DEGREES)}°/s`;
  return unit === "m" ? `${told(value * 1000)} mm` : "";
}

function colour(k) {   // ten that are told apart well, then further ones around the circle
  const ten = ["#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf"];
  return ten[k] ?? `hsl(${Math.round(k * 137.5) % 360} 65% ${k % 2 ? 42 : 58}%)`;
}

const themed = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const onTheme = (listener) => matchMedia("(prefers-color-scheme: dark)").addEventListener("change", listener);

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
