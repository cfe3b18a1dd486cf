"use strict";
(() => {
  const root = document.getElementById("player");
  const film = JSON.parse(root.querySelector('script[type="application/json"]').textContent);
  const find = (name) => root.querySelector(name);
  const canvas = find("canvas"), pen = canvas.getContext("2d");
  const clock = find(".clock"), slider = find(".time"), speed = find(".speed"), table = find(".now");
  const frames = film.t.length, start = film.t[0], end = film.t[frames - 1];
  const INK = "#1f2430", SOFT = "#5f6675", GREY = "#9aa0ab", GRID = "#e6e9ee";

  // --- data ------------------------------------------------------------------------------------------------

  const unpack = ([low, step, text]) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Float64Array.from({ length: bytes.length / 2 }, (_, k) => {
      const code = view.getInt16(2 * k, true);
      return code === -32768 ? NaN : low + step * (code + 32500);
    });
  };
  const open = (item) => Object.fromEntries(Object.entries(item.channels).map(([name, data]) => [name, unpack(data)]));
  const robots = film.robots.map((item) => ({ name: item.name, colour: item.colour, views: item.views, ...open(item) }));
  const targets = film.targets.map((item) => ({
    name: item.name,
    tracks: item.tracks.map((track) => ({ colour: robots[track.robot].colour, robot: track.robot, ...open(track) })),
  }));
  const index = Object.fromEntries(robots.map((item, k) => [item.name, k]));

  let k = 0, part = 0;  // the frame before now, and how far it is to the next
  const seek = (t) => {
    let low = 0, high = frames - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (film.t[middle] <= t) low = middle; else high = middle;
    }
    k = low;
    part = frames > 1 ? Math.min(1, Math.max(0, (t - film.t[k]) / (film.t[k + 1] - film.t[k]))) : 0;
  };
  const at = (values) => {
    const a = values[k], b = values[Math.min(k + 1, frames - 1)];
    return Number.isNaN(b) ? (part < 0.5 ? a : b) : Number.isNaN(a) ? (part < 0.5 ? a : b) : a + part * (b - a);
  };
  const turned = (values, period) => {
    const a = values[k], b = values[Math.min(k + 1, frames - 1)];
    if (Number.isNaN(a) || Number.isNaN(b)) return part < 0.5 ? a : b;
    return a + part * (b - a - period * Math.round((b - a) / period));
  };

  // --- from metres to pixels -------------------------------------------------------------------------------

  const bounds = () => {
    const xs = [], ys = [];
    const add = (x, y) => { if (Number.isFinite(x) && Number.isFinite(y)) { xs.push(x); ys.push(y); } };
    for (const item of [...robots, ...targets.map((target) => target.tracks[0])]) {
      for (let i = 0; i < frames; i++) add(item.X[i], item.Y[i]);
    }
    for (const item of film.landmarks) add(...item.at);
    const low = (values) => values.reduce((a, b) => Math.min(a, b)), high = (values) => values.reduce((a, b) => Math.max(a, b));
    const box = { x0: low(xs), x1: high(xs), y0: low(ys), y1: high(ys) };
    const margin = 0.1 * Math.max(box.x1 - box.x0, box.y1 - box.y0, 1);
    return { x0: box.x0 - margin, x1: box.x1 + margin, y0: box.y0 - margin, y1: box.y1 + margin };
  };
  const box = bounds();
  let width = 0, height = 0, scale = 1;
  const px = (x) => width / 2 + (x - (box.x0 + box.x1) / 2) * scale;
  const py = (y) => height / 2 - (y - (box.y0 + box.y1) / 2) * scale;
  const resize = () => {
    const ratio = window.devicePixelRatio || 1;
    width = canvas.parentElement.clientWidth;
    const shape = (box.y1 - box.y0) / (box.x1 - box.x0);
    height = Math.round(width * Math.min(0.68, Math.max(0.4, shape)));
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    canvas.style.height = `${height}px`;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    scale = Math.min(width / (box.x1 - box.x0), height / (box.y1 - box.y0));
  };

  // --- drawing ---------------------------------------------------------------------------------------------

  const line = (x0, y0, x1, y1) => { pen.beginPath(); pen.moveTo(x0, y0); pen.lineTo(x1, y1); pen.stroke(); };
  const write = (text, x, y, colour) => {
    pen.lineWidth = 3; pen.strokeStyle = "rgba(255,255,255,.85)"; pen.fillStyle = colour;
    pen.strokeText(text, x, y); pen.fillText(text, x, y);
  };
  const grid = () => {
    const rough = 90 / scale, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= rough);
    const digits = Math.max(0, -Math.floor(Math.log10(step)));
    pen.lineWidth = 1; pen.strokeStyle = GRID; pen.fillStyle = GREY; pen.font = "11px system-ui, sans-serif";
    const left = (box.x0 + box.x1) / 2 - width / 2 / scale, low = (box.y0 + box.y1) / 2 - height / 2 / scale;
    for (let x = Math.ceil(left / step) * step; px(x) < width; x += step) {
      line(px(x), 0, px(x), height);
      pen.fillText(`${x.toFixed(digits)}`, px(x) + 3, height - 5);
    }
    for (let y = Math.ceil(low / step) * step; py(y) > 0; y += step) {
      line(0, py(y), width, py(y));
      if (py(y) < height - 20) pen.fillText(`${y.toFixed(digits)}${py(y) < step * scale ? " m" : ""}`, 4, py(y) - 3);
    }
  };
  const path = (xs, ys, from, to) => {
    pen.beginPath();
    let drawing = false;
    for (let i = from; i <= to; i++) {
      if (Number.isNaN(xs[i])) { drawing = false; continue; }
      if (drawing) pen.lineTo(px(xs[i]), py(ys[i])); else pen.moveTo(px(xs[i]), py(ys[i]));
      drawing = true;
    }
    pen.stroke();
  };
  const arrow = (x, y, heading, size, colour, filled) => {
    pen.save();
    pen.translate(px(x), py(y));
    pen.rotate(-heading);
    pen.beginPath();
    if (Number.isNaN(heading)) pen.arc(0, 0, size * 0.7, 0, 2 * Math.PI);
    else { pen.moveTo(size * 1.3, 0); pen.lineTo(-size * 0.8, size * 0.75); pen.lineTo(-size * 0.4, 0); pen.lineTo(-size * 0.8, -size * 0.75); pen.closePath(); }
    pen.lineWidth = 1.6; pen.strokeStyle = filled ? "#fff" : colour; pen.fillStyle = filled ? colour : "#fff";
    if (filled) { pen.lineWidth = 1; pen.stroke(); pen.fill(); } else { pen.fill(); pen.stroke(); }
    pen.restore();
  };
  const star = (x, y, size) => {
    pen.beginPath();
    for (let i = 0; i < 10; i++) {
      const radius = i % 2 ? size * 0.42 : size, angle = Math.PI / 2 + i * Math.PI / 5;
      pen.lineTo(px(x) + radius * Math.cos(angle), py(y) - radius * Math.sin(angle));
    }
    pen.closePath();
    pen.fillStyle = INK; pen.strokeStyle = "#fff"; pen.lineWidth = 1.5; pen.stroke(); pen.fill();
  };
  const ellipse = (item, colour, strength) => {
    const a = at(item.a), b = at(item.b);
    if (Number.isNaN(a) || Number.isNaN(at(item.x))) return;
    pen.beginPath();
    pen.ellipse(px(at(item.x)), py(at(item.y)), Math.max(a * scale, 1), Math.max(b * scale, 1), -turned(item.p, Math.PI), 0, 2 * Math.PI);
    pen.fillStyle = colour; pen.strokeStyle = colour; pen.lineWidth = 1.2;
    pen.globalAlpha = 0.1 * strength; pen.fill();
    pen.globalAlpha = 0.65 * strength; pen.stroke();
    pen.globalAlpha = 1;
  };

  const views = (item) => {  // from where the robot is, not from where it believes to be
    const heading = item.H ? turned(item.H, 2 * Math.PI) : NaN;
    if (Number.isNaN(heading) || Number.isNaN(at(item.X))) return;
    const far = 0.2 * Math.max(box.x1 - box.x0, box.y1 - box.y0);
    for (const [x, y, yaw, fov, least, most] of item.views) {
      const cx = px(at(item.X) + x * Math.cos(heading) - y * Math.sin(heading));
      const cy = py(at(item.Y) + x * Math.sin(heading) + y * Math.cos(heading));
      const left = -(heading + yaw + 0.5 * fov), right = -(heading + yaw - 0.5 * fov);
      pen.beginPath();
      pen.arc(cx, cy, (most ?? Math.max(far, 2 * least)) * scale, left, right);
      pen.arc(cx, cy, least * scale, right, left, true);
      pen.closePath();
      pen.fillStyle = item.colour; pen.strokeStyle = item.colour; pen.lineWidth = 0.8;
      pen.globalAlpha = 0.09; pen.fill();
      pen.globalAlpha = 0.4; pen.stroke();
      pen.globalAlpha = 1;
    }
  };

  const place = (name) => {
    if (name in index) { const item = robots[index[name]]; return [at(item.X), at(item.Y)]; }
    const [kind, rest] = [name.slice(0, name.indexOf(":")), name.slice(name.indexOf(":") + 1)];
    if (kind === "target") {
      const target = targets.find((item) => item.name === rest);
      return target ? [at(target.tracks[0].X), at(target.tracks[0].Y)] : null;
    }
    const mark = film.landmarks.find((item) => item.name === rest);
    return mark ? mark.at : null;
  };
  const before = (times, t) => {  // how many are not after t
    let low = 0, high = times.length;
    while (low < high) { const middle = (low + high) >> 1; if (times[middle] <= t) low = middle + 1; else high = middle; }
    return low;
  };
  const starts = film.seen.map((item) => item.spells.map((spell) => spell[0]));
  const join = (a, b) => { if (a && b) line(px(a[0]), py(a[1]), px(b[0]), py(b[1])); };
  const links = (t) => {
    const slack = (end - start) / 1000;
    film.seen.forEach((item, n) => {
      const last = before(starts[n], t + slack) - 1;
      if (last < 0 || item.spells[last][1] < t - slack) return;
      const peer = item.of in index;
      pen.strokeStyle = peer ? SOFT : GREY; pen.lineWidth = peer ? 1.4 : 0.9;
      pen.globalAlpha = peer ? 0.75 : 0.6;
      pen.setLineDash(peer ? [] : [3, 4]);
      join(place(item.robot), place(item.of));
      pen.setLineDash([]); pen.globalAlpha = 1;
    });
    const fade = Math.max(0.35 * Number(speed.value), (end - start) / 300);
    for (const item of film.contacts) {
      const last = before(item.t, t) - 1;
      if (last < 0) continue;
      const strength = Math.exp(-(t - item.t[last]) / fade);
      if (strength < 0.05) continue;
      pen.strokeStyle = "#E69F00"; pen.lineWidth = 2 + 4 * strength; pen.globalAlpha = strength; pen.lineCap = "round";
      join(place(item.pair[0]), place(item.pair[1]));
      pen.globalAlpha = 1; pen.lineCap = "butt";
    }
  };

  const draw = (t) => {
    seek(t);
    pen.clearRect(0, 0, width, height);
    grid();
    pen.font = "600 12px system-ui, sans-serif"; pen.textAlign = "left"; pen.textBaseline = "alphabetic";
    for (const item of film.landmarks) {
      const [x, y] = [px(item.at[0]), py(item.at[1])];
      pen.fillStyle = GREY; pen.beginPath(); pen.moveTo(x, y - 6); pen.lineTo(x + 5.5, y + 4); pen.lineTo(x - 5.5, y + 4); pen.closePath(); pen.fill();
      if (film.landmarks.length <= 8) write(item.name, x + 8, y + 4, GREY);
    }
    if (find(".paths").checked) {
      pen.strokeStyle = "#c9cdd5"; pen.lineWidth = 1;
      for (const item of robots) path(item.X, item.Y, 0, frames - 1);
      pen.strokeStyle = GREY; pen.setLineDash([5, 3]);
      for (const target of targets) path(target.tracks[0].X, target.tracks[0].Y, 0, frames - 1);
      pen.setLineDash([]);
    }
    const tail = Math.max(0, k - Math.ceil(frames / 16));
    pen.lineWidth = 1.6;
    for (const item of robots) { pen.strokeStyle = item.colour; pen.globalAlpha = 0.55; path(item.x, item.y, tail, k); pen.globalAlpha = 1; }
    if (find(".views").checked) robots.forEach(views);
    if (find(".links").checked) links(t);
    const shown = find(".ellipses").checked;
    for (const target of targets) {
      for (const track of target.tracks) {
        if (shown) ellipse(track, track.colour, 0.55);
        if (!Number.isNaN(at(track.x))) {
          pen.beginPath(); pen.arc(px(at(track.x)), py(at(track.y)), 3.4, 0, 2 * Math.PI);
          pen.fillStyle = track.colour; pen.strokeStyle = "#fff"; pen.lineWidth = 1; pen.stroke(); pen.fill();
        }
      }
      star(at(target.tracks[0].X), at(target.tracks[0].Y), 8);
      write(target.name, px(at(target.tracks[0].X)) + 10, py(at(target.tracks[0].Y)) - 8, INK);
    }
    if (shown) for (const item of robots) ellipse(item, item.colour, 1);
    for (const item of robots) arrow(at(item.X), at(item.Y), item.H ? turned(item.H, 2 * Math.PI) : NaN, 8, item.colour, false);
    for (const item of robots) {
      if (Number.isNaN(at(item.x))) continue;
      arrow(at(item.x), at(item.y), item.h ? turned(item.h, 2 * Math.PI) : NaN, 8, item.colour, true);
      write(item.name + (item.z ? `  ${at(item.z).toFixed(1)} m` : ""), px(at(item.x)) + 11, py(at(item.y)) - 9, item.colour);
    }
    pen.font = "600 15px system-ui, sans-serif"; pen.textAlign = "right";
    write(`${t.toFixed(end - start < 60 ? 1 : 0)} s`, width - 12, 24, INK);
    pen.textAlign = "left";
    tell();
  };

  // --- figures beside the picture --------------------------------------------------------------------------

  const cell = (row, text) => { const item = document.createElement("td"); item.textContent = text; row.append(item); return item; };
  const cells = [];
  const head = table.insertRow();
  for (const text of ["", "error now", "claimed 3σ", ...targets.map((target) => `error of ${target.name}`)]) {
    const item = document.createElement("th"); item.textContent = text; head.append(item);
  }
  for (const item of robots) {
    const row = table.insertRow(), name = cell(row, "");
    const dot = document.createElement("i");
    dot.className = "dot"; dot.style.background = item.colour;
    name.append(dot, item.name);
    cells.push([cell(row, ""), cell(row, ""), ...targets.map(() => cell(row, ""))]);
  }
  const metres = (value) => (Number.isNaN(value) ? "–" : `${value.toFixed(2)} m`);
  const tell = () => robots.forEach((item, n) => {
    const own = [at(item.e), at(item.a), ...targets.map((target) => {
      const track = target.tracks.find((one) => one.robot === n);
      return track ? at(track.e) : NaN;
    })];
    own.forEach((value, column) => { cells[n][column].textContent = metres(value); });
    cells[n][0].className = own[0] > own[1] ? "warn" : "";
  });

  // --- controls --------------------------------------------------------------------------------------------

  let now = start + 0.3 * (end - start), playing = false, stamp = 0, begun = false;
  for (const value of film.speeds) speed.add(new Option(`${value} ×`, String(value), false, value === film.speed));
  const show = () => {
    draw(now);
    slider.value = String(Math.round(1000 * (now - start) / (end - start || 1)));
    clock.textContent = `${now.toFixed(0)} / ${end.toFixed(0)} s`;
  };
  const step = (time) => {
    if (!playing) return;
    now = Math.min(end, now + (time - stamp) / 1000 * Number(speed.value));
    stamp = time;
    show();
    if (now >= end) pause(); else requestAnimationFrame(step);
  };
  const pause = () => { playing = false; find(".play").textContent = "▶"; };
  const play = () => {
    if (!begun || now >= end) now = start;
    begun = playing = true;
    find(".big").hidden = true;
    find(".play").textContent = "❚❚";
    stamp = performance.now();
    requestAnimationFrame(step);
  };
  const toggle = () => (playing ? pause() : play());
  find(".play").addEventListener("click", toggle);
  find(".stage").addEventListener("click", toggle);
  slider.addEventListener("input", () => {
    begun = true; find(".big").hidden = true; pause();
    now = start + (end - start) * Number(slider.value) / 1000;
    show();
  });
  for (const name of [".ellipses", ".paths", ".links", ".views"]) find(name).addEventListener("change", show);
  new ResizeObserver(() => requestAnimationFrame(() => { resize(); show(); })).observe(canvas.parentElement);
})();
