"use strict";

// Shows the content of a run: playback on a canvas, charts as SVG, tables. All texts are inserted as text.
(async () => {
  const early = []; // content of a running episode that comes before the page is built
  let take = (content) => early.push(content);
  document.addEventListener("content", (event) => take(event.detail));
  let page = JSON.parse(document.getElementById("data").textContent);
  let bytes = await inflated(document.getElementById("arrays").textContent);

  // ------------------------------------------------------------ helpers

  /** Decode base64 and inflate it. */
  async function inflated(text) {
    const packed = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  }

  /** Return the numbers of a packed array. */
  function unpacked(about) {
    const { kind, begin, size } = about;
    if (kind === "u8") return new Uint8Array(bytes, begin, size);
    if (kind === "i32") return new Int32Array(bytes, begin, size);
    const codes = new Int16Array(bytes, begin, size);
    return Float64Array.from(codes, (code) => (code === -32768 ? NaN : code * about.scale + about.offset));
  }

  /** Make an element with attributes and children; texts become text nodes. */
  function make(name, attributes = {}, ...children) {
    const isSvg = ["svg", "path", "line", "text", "g", "rect"].includes(name);
    const element = isSvg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) {
      if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
      else element.setAttribute(key, value);
    }
    element.append(...children);
    return element;
  }

  /** Return the index of the last value that is not above a limit; 0 if there is none. */
  function lastUpTo(values, limit) {
    let low = 0, high = values.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (values[middle] <= limit) low = middle + 1;
      else high = middle;
    }
    return Math.max(low - 1, 0);
  }

  let seekers = []; // called with the time of the playback

  // ------------------------------------------------------------ head and foot

  document.querySelector("h1").textContent = page.title;
  if (page.command) document.getElementById("command").append("Repeat it: ", make("code", {}, page.command));
  const about = document.getElementById("about");
  if (page.about.length) {
    const facts = page.about.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]);
    about.append(make("h2", {}, "About this run"), make("dl", {}, ...facts));
  }
  if (page.config) {
    about.append(make("details", {}, make("summary", {}, "config.toml"), make("pre", {}, page.config)));
  }

  // ------------------------------------------------------------ playback

  let seek = null;

  function playback(episode) {
    let data, times, end, needs;
    function read() {
      data = Object.fromEntries(Object.entries(episode.arrays).map(([name, packed]) => [name, unpacked(packed)]));
      times = data.times;
      end = times[times.length - 1];
      needs = {
        truth: data.walls.length || data.landmarks.length || data.truth.some((value) => !isNaN(value)), maps: data.mapXY.length,
        ellipses: data.mapXY.length, paths: true, reckoned: data.reckoned.length, sights: data.sights.length,
        grids: data.gridRuns.length, candidates: data.candidateXY.length,
      };
    }
    read();
    const names = episode.names, count = names.length;
    const canvas = document.querySelector("canvas"), pen = canvas.getContext("2d");
    const slider = document.getElementById("slider"), play = document.getElementById("play");
    const caption = document.getElementById("caption"), clock = document.getElementById("time");
    const layers = [
      ["truth", "truth: walls, landmarks, faint paths, filled robots", true], ["maps", "maps", true],
      ["ellipses", "95 % ellipses", true], ["paths", "estimated paths", true], ["reckoned", "odometry only (dotted)", false],
      ["sights", "lines of sight", true], ["grids", "occupancy grids", false],
      ["candidates", "candidates", false],
    ];
    const shown = {}, labels = {};
    const panel = document.getElementById("layers");
    const kindColours = ["#b8860b", "#8e44ad", "#16a085"];
    for (const [name, text, isOn] of layers) {
      shown[name] = isOn;
      const box = make("input", { type: "checkbox", id: `layer-${name}` });
      box.checked = shown[name];
      box.addEventListener("change", () => { shown[name] = box.checked; draw(); });
      const words = [text];
      if (name === "candidates") {
        words.splice(0, 1, "candidates: ", ...Object.entries(episode.kinds).flatMap(([value, kind]) => {
          const dot = make("span", { class: "dot" });
          dot.style.background = kindColours[value % 3];
          return [dot, `${kind.replace("_", " ")} `];
        }), "; ring: goal");
      }
      panel.append(labels[name] = make("label", {}, box, " ", ...words));
    }
    function offerLayers() {
      for (const [name, label] of Object.entries(labels)) label.hidden = !needs[name];
    }
    offerLayers();
    panel.append(make("p", { class: "note" }, `Estimates are placed ${episode.placed}.`));

    const state = { time: 0, playing: false, following: false, speed: 10, zoom: 1, x: 0, y: 0, stamp: 0 };
    slider.max = end;

    // extent of the world
    const box = [Infinity, Infinity, -Infinity, -Infinity];
    function include(values, step, columns) {
      for (let i = 0; i + columns.length <= values.length; i += step) {
        for (const [x, y] of columns) {
          if (isNaN(values[i + x]) || isNaN(values[i + y])) continue;
          box[0] = Math.min(box[0], values[i + x]); box[1] = Math.min(box[1], values[i + y]);
          box[2] = Math.max(box[2], values[i + x]); box[3] = Math.max(box[3], values[i + y]);
        }
      }
    }
    if (data.walls.length) include(data.walls, 4, [[0, 1], [2, 3]]);
    else { include(data.estimate, 3, [[0, 1]]); include(data.truth, 3, [[0, 1]]); include(data.landmarks, 2, [[0, 1]]); }
    if (!isFinite(box[0])) box.splice(0, 4, -1, -1, 1, 1);
    canvas.style.aspectRatio = Math.max(box[2] - box[0], 1) / Math.max(box[3] - box[1], 1); // no empty space on a phone

    function fit() {
      state.zoom = 1;
      state.x = (box[0] + box[2]) / 2;
      state.y = (box[1] + box[3]) / 2;
    }
    function scale() {
      const wide = Math.max(box[2] - box[0], 1), tall = Math.max(box[3] - box[1], 1);
      return state.zoom * Math.min((canvas.width - 40) / wide, (canvas.height - 64 * (window.devicePixelRatio || 1)) / tall); // room for the scale bar
    }
    const px = (x, s) => (x - state.x) * s + canvas.width / 2;
    const py = (y, s) => canvas.height / 2 - (y - state.y) * s;

    const grids = new Map(); // decoded pictures by keyframe and robot
    function gridPicture(key, robot) {
      const index = key * count + robot, name = `${index}`;
      if (grids.has(name)) return grids.get(name);
      const first = index ? data.gridEnds[index - 1] : 0, last = data.gridEnds[index];
      let picture = null;
      if (last > first) {
        const rows = Math.round(data.gridBoxes[4 * index + 2]), columns = Math.round(data.gridBoxes[4 * index + 3]);
        picture = make("canvas", { width: columns, height: rows });
        const image = new ImageData(columns, rows), cells = new Uint32Array(image.data.buffer);
        let at = 0;
        for (let run = first; run < last; run++) {
          const value = data.gridValues[run];
          cells.fill(value === episode.free ? 0xffe4f0dc : value === episode.occupied ? 0xff707070 : 0, at, at + data.gridRuns[run]);
          at += data.gridRuns[run];
        }
        picture.getContext("2d").putImageData(image, 0, 0);
      }
      if (grids.size > 60) grids.clear();
      grids.set(name, picture);
      return picture;
    }

    function drawGrids(key, s) {
      const frame = data.keyframes[key];
      for (let robot = 0; robot < count; robot++) {
        const label = data.frames[frame * count + robot];
        if (data.frames.slice(frame * count, frame * count + robot).includes(label)) continue; // another robot has it
        let from = key;
        while (from > 0 && !gridPicture(from, robot)) from--;
        const picture = gridPicture(from, robot);
        if (!picture) continue;
        const index = 4 * (from * count + robot), x = data.gridBoxes[index], y = data.gridBoxes[index + 1];
        const [sx, sy, angle] = data.starts.slice(3 * robot, 3 * robot + 3), c = Math.cos(angle), n = Math.sin(angle), cell = s * episode.cell;
        pen.save();
        pen.imageSmoothingEnabled = false;
        pen.globalAlpha = 0.8;
        pen.setTransform(cell * c, -cell * n, -cell * n, -cell * c, px(sx + c * x - n * y, s), py(sy + n * x + c * y, s));
        pen.drawImage(picture, 0, 0);
        pen.restore();
      }
    }

    function drawPath(poses, robot, upTo, s) {
      pen.beginPath();
      let isDown = false;
      for (let i = 0; i <= upTo; i++) {
        const at = 3 * (i * count + robot), x = poses[at], y = poses[at + 1];
        if (isNaN(x)) { isDown = false; continue; }
        if (isDown) pen.lineTo(px(x, s), py(y, s));
        else pen.moveTo(px(x, s), py(y, s));
        isDown = true;
      }
      pen.stroke();
    }

    /** Return a pose between two recorded steps. */
    function poseAt(poses, robot, i, share) {
      const at = 3 * (i * count + robot), next = i + 1 < times.length ? at + 3 * count : at;
      const turn = Math.atan2(Math.sin(poses[next + 2] - poses[at + 2]), Math.cos(poses[next + 2] - poses[at + 2]));
      const pose = [0, 1].map((k) => poses[at + k] + share * (poses[next + k] - poses[at + k]));
      return [...pose, poses[at + 2] + share * turn];
    }

    function ellipse(x, y, a, b, angle, s) {
      pen.beginPath();
      pen.ellipse(px(x, s), py(y, s), Math.max(a * s, 0.5), Math.max(b * s, 0.5), -angle, 0, 2 * Math.PI);
      pen.stroke();
    }

    function draw() {
      const ratio = window.devicePixelRatio || 1, wide = Math.round(canvas.clientWidth * ratio), tall = Math.round(canvas.clientHeight * ratio);
      if (canvas.width !== wide || canvas.height !== tall) { canvas.width = wide; canvas.height = tall; }
      const s = scale(), i = lastUpTo(times, state.time), key = data.keyframes.length ? lastUpTo(data.keyframes, i) : -1;
      const gap = i + 1 < times.length ? times[i + 1] - times[i] : 1, share = Math.min(Math.max((state.time - times[i]) / gap, 0), 1);
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.clearRect(0, 0, wide, tall);
      pen.lineCap = "round";
      if (shown.grids && key >= 0) drawGrids(key, s);
      if (shown.truth) {
        pen.strokeStyle = "#b0b2b8";
        pen.lineWidth = Math.max(2 * ratio, 0.08 * s);
        pen.beginPath();
        for (let w = 0; w < data.walls.length; w += 4) {
          pen.moveTo(px(data.walls[w], s), py(data.walls[w + 1], s));
          pen.lineTo(px(data.walls[w + 2], s), py(data.walls[w + 3], s));
        }
        pen.stroke();
        pen.fillStyle = "#55575e";
        for (let n = 0; n < data.landmarks.length; n += 2) {
          pen.fillRect(px(data.landmarks[n], s) - ratio, py(data.landmarks[n + 1], s) - ratio, 2 * ratio, 2 * ratio);
        }
        pen.globalAlpha = 0.22;
        pen.lineWidth = 4 * ratio;
        for (let robot = 0; robot < count; robot++) { pen.strokeStyle = episode.colours[robot]; drawPath(data.truth, robot, i, s); }
        pen.globalAlpha = 1;
      }
      if (shown.reckoned && data.reckoned.length) {
        pen.lineWidth = ratio;
        pen.setLineDash([2 * ratio, 3 * ratio]);
        for (let robot = 0; robot < count; robot++) { pen.strokeStyle = episode.colours[robot]; drawPath(data.reckoned, robot, i, s); }
        pen.setLineDash([]);
      }
      if (key >= 0) drawMaps(key, s, ratio);
      for (let robot = 0; robot < count; robot++) drawRobot(robot, i, share, s, ratio);
      if (shown.candidates && key >= 0) drawCandidates(key, s, ratio);
      drawScaleBar(s, ratio);
      showTexts(i);
    }

    function drawMaps(key, s, ratio) {
      for (let robot = 0; robot < count; robot++) {
        const index = key * count + robot, first = index ? data.mapEnds[index - 1] : 0, last = data.mapEnds[index];
        pen.fillStyle = pen.strokeStyle = episode.colours[robot];
        pen.lineWidth = 0.8 * ratio;
        for (let n = first; n < last; n++) {
          const x = data.mapXY[2 * n], y = data.mapXY[2 * n + 1];
          if (shown.maps) {
            pen.beginPath();
            pen.arc(px(x, s), py(y, s), 2 * ratio, 0, 2 * Math.PI);
            pen.fill();
          }
          if (shown.ellipses) {
            pen.globalAlpha = 0.5;
            ellipse(x, y, data.mapAxes[2 * n], data.mapAxes[2 * n + 1], data.mapAngles[n], s);
            pen.globalAlpha = 1;
          }
        }
      }
    }

    function drawRobot(robot, i, share, s, ratio) {
      const colour = episode.colours[robot], radius = Math.max(0.2 * s, 5 * ratio);
      const estimate = poseAt(data.estimate, robot, i, share), truth = poseAt(data.truth, robot, i, share);
      pen.strokeStyle = pen.fillStyle = colour;
      if (shown.paths) { pen.lineWidth = 1.4 * ratio; drawPath(data.estimate, robot, i, s); }
      const isTrue = shown.truth && !isNaN(truth[0]), body = isTrue ? truth : estimate;
      if (shown.sights && data.sights.length) {
        const index = i * count + robot, first = index ? data.sightEnds[index - 1] : 0;
        pen.lineWidth = ratio;
        pen.globalAlpha = 0.55;
        for (let n = first; n < data.sightEnds[index]; n++) {
          pen.beginPath();
          pen.moveTo(px(body[0], s), py(body[1], s));
          pen.lineTo(px(data.sights[2 * n], s), py(data.sights[2 * n + 1], s));
          pen.stroke();
        }
        pen.globalAlpha = 1;
      }
      if (isNaN(body[0])) return;
      pen.beginPath();
      pen.arc(px(body[0], s), py(body[1], s), radius, 0, 2 * Math.PI);
      pen.fill();
      pen.strokeStyle = "#fff";
      pen.lineWidth = 2 * ratio;
      pen.beginPath();
      pen.moveTo(px(body[0], s), py(body[1], s));
      pen.lineTo(px(body[0], s) + radius * Math.cos(body[2]), py(body[1], s) - radius * Math.sin(body[2]));
      pen.stroke();
      if (isTrue) {
        pen.strokeStyle = colour;
        pen.lineWidth = 1.6 * ratio;
        pen.beginPath();
        pen.arc(px(estimate[0], s), py(estimate[1], s), radius + 3 * ratio, 0, 2 * Math.PI);
        pen.stroke();
      }
      if (shown.ellipses && data.ellipses.length) {
        const at = 3 * (i * count + robot);
        pen.strokeStyle = colour;
        pen.lineWidth = ratio;
        ellipse(estimate[0], estimate[1], data.ellipses[at], data.ellipses[at + 1], data.ellipses[at + 2], s);
      }
      pen.fillStyle = "#34363c";
      pen.font = `${11 * ratio}px system-ui, sans-serif`;
      pen.fillText(names[robot].replace("robot ", ""), px(body[0], s) + radius + 4 * ratio, py(body[1], s) - radius);
    }

    function drawCandidates(key, s, ratio) {
      const first = key ? data.candidateEnds[key * count - 1] : 0, last = data.candidateEnds[key * count + count - 1];
      for (let n = first; n < last; n++) {
        const x = px(data.candidateXY[2 * n], s), y = py(data.candidateXY[2 * n + 1], s);
        pen.fillStyle = pen.strokeStyle = kindColours[data.candidateKinds[2 * n]] || "#34363c"; // goals that are no candidates
        pen.beginPath();
        pen.arc(x, y, 3 * ratio, 0, 2 * Math.PI);
        pen.fill();
        if (!data.candidateKinds[2 * n + 1]) continue;
        pen.lineWidth = 2 * ratio;
        pen.beginPath();
        pen.arc(x, y, 7 * ratio, 0, 2 * Math.PI);
        pen.stroke();
      }
    }

    function drawScaleBar(s, ratio) {
      const metres = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100].find((length) => length * s >= 60 * ratio) || 200;
      const x = 14 * ratio, y = canvas.height - 14 * ratio;
      pen.strokeStyle = pen.fillStyle = "#34363c";
      pen.lineWidth = 2 * ratio;
      pen.beginPath();
      pen.moveTo(x, y - 4 * ratio); pen.lineTo(x, y); pen.lineTo(x + metres * s, y); pen.lineTo(x + metres * s, y - 4 * ratio);
      pen.stroke();
      pen.font = `${11 * ratio}px system-ui, sans-serif`;
      pen.fillText(`${metres} m`, x + 5 * ratio, y - 5 * ratio);
    }

    // texts beside the picture
    const rows = names.map((name, robot) => {
      const dot = make("span", { class: "dot" });
      dot.style.background = episode.colours[robot];
      return make("tr", {}, make("td", {}, dot, name), make("td"), make("td"), make("td"));
    });
    const hasTruth = data.truth.some((value) => !isNaN(value));
    document.getElementById("robots").append(
      make("tr", {}, ...["", data.errors.length ? "E [m]" : "", hasTruth ? "pose error [m]" : "", data.frames.length ? "map of robots" : ""].map((text) => make("th", {}, text))), ...rows,
    );
    let events = [], items = [];
    const list = document.getElementById("events"), refusals = document.getElementById("refusals");
    function readEvents() {
      events = episode.events;
      items = events.map((event) => {
      const kind = event.success ? event.kind : "refused";
      const text = `${event.time.toFixed(1)} s  ${event.text}${event.error_m === undefined || event.error_m === null ? "" : `, error ${event.error_m.toFixed(2)} m, ${event.error_deg.toFixed(1)}°`}${event.false ? ": a false merge" : ""}`;
      return make("li", { class: kind }, make("button", { type: "button", onclick: () => jump(event.time) }, text));
      });
      listEvents();
    }
    function listEvents() {
      const wanted = items.filter((_, n) => refusals.checked || events[n].kind !== "attempt");
      list.replaceChildren(...(wanted.length ? wanted : [make("li", { class: "note" }, "None.")]));
    }
    refusals.addEventListener("change", listEvents);
    readEvents();

    function showTexts(i) {
      clock.textContent = `${state.time.toFixed(1)} of ${end.toFixed(1)} s`;
      slider.value = state.time;
      rows.forEach((row, robot) => {
        const at = i * count + robot, p = 3 * at;
        const off = Math.hypot(data.estimate[p] - data.truth[p], data.estimate[p + 1] - data.truth[p + 1]);
        row.cells[1].textContent = data.errors.length ? data.errors[at].toFixed(2) : "";
        row.cells[2].textContent = isNaN(off) ? "" : off.toFixed(off < 1 ? 3 : off < 10 ? 2 : 1);
        if (data.frames.length) {
          const group = names.map((_, other) => other).filter((other) => data.frames[i * count + other] === data.frames[at]);
          row.cells[3].textContent = group.join(", ");
        }
      });
      const recent = events.filter((event) => event.kind !== "attempt" && event.time <= state.time && state.time - event.time < Math.max(2, 1.5 * state.speed));
      caption.classList.toggle("shown", recent.length > 0);
      if (recent.length) caption.textContent = recent[recent.length - 1].text;
    }

    // time
    function moveTo(time) {
      state.time = Math.min(Math.max(time, 0), end);
      draw();
      for (const follow of seekers) follow(state.time);
    }
    function step(stamp) {
      if (!state.playing) return;
      if (state.stamp) moveTo(state.time + state.speed * Math.min(stamp - state.stamp, 100) / 1000);
      state.stamp = stamp;
      if (state.time >= end) setPlaying(false);
      else requestAnimationFrame(step);
    }
    /** Move there; who jumps back no longer follows a running episode, who jumps to its end does. */
    function jump(time) {
      state.following = time >= end;
      moveTo(time);
    }
    let isMoving = false; // whether a step towards the end of a running episode is due
    function follow(stamp) {
      isMoving = state.following && !state.playing && state.time < end;
      if (!isMoving) return;
      const gap = state.stamp ? Math.min(stamp - state.stamp, 100) / 1000 : 0;
      state.stamp = stamp;
      moveTo(end - state.time < 0.02 ? end : end - (end - state.time) * Math.exp(-3 * gap));
      requestAnimationFrame(follow);
    }
    /** Take newer content of a running episode. */
    function renew(newer) {
      const wasAtEnd = state.time >= end;
      episode = newer;
      read();
      offerLayers();
      readEvents();
      grids.clear();
      slider.max = end;
      state.following = state.following || (wasAtEnd && !state.playing);
      draw();
      if (isMoving || state.playing) return;
      state.stamp = 0;
      requestAnimationFrame(follow);
    }
    function setPlaying(isPlaying) {
      if (isPlaying && state.time >= end) moveTo(0);
      state.following = !isPlaying && state.time >= end;
      state.playing = isPlaying;
      state.stamp = 0;
      play.textContent = isPlaying ? "Pause" : "Play";
      if (isPlaying) requestAnimationFrame(step);
    }
    play.addEventListener("click", () => setPlaying(!state.playing));
    slider.addEventListener("input", () => { setPlaying(false); jump(Number(slider.value)); });
    document.getElementById("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
    document.getElementById("whole").addEventListener("click", () => { fit(); draw(); });
    document.addEventListener("keydown", (event) => {
      if (/^(INPUT|SELECT|BUTTON|SUMMARY)$/.test(event.target.tagName)) return;
      const acts = {
        " ": () => setPlaying(!state.playing), ArrowRight: () => jump(state.time + 1), ArrowLeft: () => jump(state.time - 1),
        Home: () => jump(0), End: () => jump(end), 0: () => { fit(); draw(); },
      };
      if (acts[event.key]) { event.preventDefault(); acts[event.key](); }
    });

    // view
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const ratio = canvas.width / canvas.clientWidth, before = scale();
      const x = event.offsetX * ratio - canvas.width / 2, y = canvas.height / 2 - event.offsetY * ratio;
      state.zoom = Math.min(Math.max(state.zoom * Math.exp(-0.0015 * event.deltaY), 0.5), 60);
      const after = scale();
      state.x += x / before - x / after;
      state.y += y / before - y / after;
      draw();
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      const ratio = canvas.width / canvas.clientWidth, s = scale();
      state.x -= event.movementX * ratio / s;
      state.y += event.movementY * ratio / s;
      draw();
    });
    new ResizeObserver(() => draw()).observe(canvas);

    document.getElementById("player").hidden = false;
    fit();
    seek = jump;
    function setLayer(name, isOn) {
      const switched = document.getElementById(`layer-${name}`);
      if (!switched || labels[name].hidden) return;
      switched.checked = isOn;
      switched.dispatchEvent(new Event("change"));
    }
    return { moveTo, setPlaying, setLayer, renew };
  }

  // ------------------------------------------------------------ charts

  /** Return about five round numbers within a range. */
  function ticks(low, high) {
    const rough = (high - low || 1) / 5, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough), found = [];
    for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9 * step; value += step) found.push(value);
    return found.map((value) => Number(value.toPrecision(12)));
  }

  function chart(about) {
    const [wide, tall, left, right, top, bottom] = [420, 222, 44, 8, 8, 36];
    const colours = page.episode ? page.episode.colours : [];
    const lines = about.lines.map((line) => ({
      ...line, colour: line.colour || colours[line.robot] || "#0072B2", x: unpacked(line.x), y: unpacked(line.y),
      low: line.low && unpacked(line.low), high: line.high && unpacked(line.high), on: true,
    }));
    const svg = make("svg", { viewBox: `0 0 ${wide} ${tall}`, role: "img", "aria-label": about.title });
    const readout = make("div", { class: "readout" });
    let cursor, scaleX, unscaleX;

    function redraw() {
      const on = lines.filter((line) => line.on);
      let [x0, x1, y0, y1] = [0, 0, 0, 0];
      for (const { x, y, low, high } of on) {
        for (let i = 0; i < x.length; i++) {
          x1 = Math.max(x1, x[i] || 0);
          for (const value of [y[i], low && low[i], high && high[i]]) {
            if (isFinite(value)) { y1 = Math.max(y1, value); y0 = Math.min(y0, value); }
          }
        }
      }
      if (y1 === y0) y1 = y0 + 1;
      if (x1 === x0) x1 = x0 + 1;
      y1 += 0.05 * (y1 - y0);
      scaleX = (value) => left + ((value - x0) / (x1 - x0)) * (wide - left - right);
      unscaleX = (place) => x0 + ((place - left) / (wide - left - right)) * (x1 - x0);
      const scaleY = (value) => tall - bottom - ((value - y0) / (y1 - y0)) * (tall - top - bottom);
      const parts = [];
      for (const value of ticks(y0, y1)) {
        parts.push(make("line", { class: "grid", x1: left, x2: wide - right, y1: scaleY(value), y2: scaleY(value) }));
        parts.push(make("text", { x: left - 5, y: scaleY(value) + 4, "text-anchor": "end" }, String(value)));
      }
      for (const value of ticks(x0, x1)) {
        parts.push(make("text", { x: scaleX(value), y: tall - 20, "text-anchor": "middle" }, String(value)));
      }
      parts.push(make("text", { x: left + (wide - left - right) / 2, y: tall - 4, "text-anchor": "middle" }, "time [s]"));
      const path = (xs, ys) => {
        let text = "", isDown = false;
        for (let i = 0; i < xs.length; i++) {
          if (isNaN(ys[i]) || isNaN(xs[i])) { isDown = false; continue; }
          text += `${isDown ? "L" : "M"}${scaleX(xs[i]).toFixed(1)} ${scaleY(ys[i]).toFixed(1)}`;
          isDown = true;
        }
        return text;
      };
      for (const { x, low, high, colour } of on) {
        if (!low) continue;
        const known = Array.from(x.keys()).filter((i) => !isNaN(low[i]) && !isNaN(high[i]));
        const forth = path(known.map((i) => x[i]), known.map((i) => high[i])), back = known.reverse();
        const down = path(back.map((i) => x[i]), back.map((i) => low[i])).replace("M", "L");
        if (forth) parts.push(make("path", { d: `${forth}${down}Z`, fill: colour, opacity: 0.16 }));
      }
      for (const { x, y, colour } of on) parts.push(make("path", { d: path(x, y), fill: "none", stroke: colour, "stroke-width": 1.6, "stroke-linejoin": "round" }));
      cursor = make("line", { class: "cursor", visibility: "hidden", x1: 0, x2: 0, y1: top, y2: tall - bottom });
      svg.replaceChildren(...parts, cursor);
    }

    function point(time) {
      const place = scaleX(time);
      cursor.setAttribute("x1", place);
      cursor.setAttribute("x2", place);
      cursor.setAttribute("visibility", "visible");
      const values = lines.filter((line) => line.on).map((line) => {
        const i = lastUpTo(line.x, time), value = about.stacked ? line.high[i] - line.low[i] : line.y[i];
        return `${line.name} ${isNaN(value) ? "-" : Number(value.toPrecision(3))}`;
      });
      readout.textContent = values.length > 6 ? `${time.toFixed(1)} s` : `${time.toFixed(1)} s: ${values.join(", ")}`;
    }
    const timeOf = (event) => {
      const area = svg.getBoundingClientRect();
      return Math.max(unscaleX(((event.clientX - area.left) / area.width) * wide), 0);
    };
    svg.addEventListener("pointermove", (event) => point(timeOf(event)));
    svg.addEventListener("click", (event) => { if (seek && page.episode) seek(timeOf(event)); });
    const legend = make("div", { class: "legend" }, ...lines.map((line) => {
      const dot = make("span", { class: "dot" });
      dot.style.background = line.colour;
      const entry = make("button", { type: "button", title: "Show or hide" }, dot, line.name);
      entry.addEventListener("click", () => { line.on = !line.on; entry.classList.toggle("off", !line.on); redraw(); });
      return entry;
    }));
    redraw();
    if (page.episode) seekers.push(point);
    const unit = about.unit ? ` [${about.unit}]` : "";
    const note = about.note ? [make("div", { class: "note" }, about.note)] : [];
    return make("div", { class: "chart" }, make("h3", {}, about.title + unit), legend, svg, readout, ...note);
  }

  // ------------------------------------------------------------ tables

  function table(about) {
    const body = make("tbody");
    const heads = about.headings.map((text, column) => make("th", { scope: "col", tabindex: "0", onclick: () => sort(column) }, text));
    let order = about.rows.map((_, row) => row);
    const lines = about.rows.map((row) => make("tr", {}, ...row.map(([text]) => make("td", {}, text))));
    function sort(column) {
      const isUp = heads[column].getAttribute("aria-sort") !== "ascending", sign = isUp ? 1 : -1;
      heads.forEach((head) => head.removeAttribute("aria-sort"));
      heads[column].setAttribute("aria-sort", isUp ? "ascending" : "descending");
      order = order.sort((one, other) => {
        const a = about.rows[one][column][1], b = about.rows[other][column][1];
        if (a === null || b === null) return (a === null) - (b === null);
        return sign * (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true }));
      });
      body.replaceChildren(...order.map((row) => lines[row]));
    }
    heads.forEach((head, column) => head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(column); }));
    body.append(...lines);
    const note = about.note ? [make("div", { class: "note" }, about.note)] : [];
    const whole = make("table", { class: "data" }, make("thead", {}, make("tr", {}, ...heads)), body);
    const parts = [...note, make("div", { class: "wide" }, whole)];
    if (about.rows.length <= 40) return make("div", {}, make("h2", {}, about.title), ...parts);
    return make("details", {}, make("summary", {}, `${about.title}: ${about.rows.length} rows`), ...parts);
  }

  // ------------------------------------------------------------ whole page

  const player = page.episode ? playback(page.episode) : null;
  function showCharts() {
    seekers = [];
    document.getElementById("charts").replaceChildren(...page.charts.map(chart));
  }
  showCharts();
  document.getElementById("tables").append(...page.tables.map(table));
  for (const { title, source } of page.pictures) {
    document.getElementById("pictures").append(make("h2", {}, title), make("img", { src: source, alt: title, loading: "lazy" }));
  }
  if (player) { // #t=30 shows that time, #play plays, #show=grids and #hide=truth,maps change layers
    const wanted = new URLSearchParams(location.hash.slice(1));
    for (const [word, isOn] of [["show", true], ["hide", false]]) {
      for (const name of (wanted.get(word) || "").split(",")) player.setLayer(name, isOn);
    }
    player.moveTo(Number(wanted.get("t")) || 0);
    if (wanted.has("play")) player.setPlaying(true);
  }
  let renewed = Promise.resolve();
  take = (content) => {
    renewed = renewed.then(async () => {
      page = content.page;
      bytes = await inflated(content.arrays);
      showCharts();
      player.renew(page.episode);
    });
  };
  early.forEach(take);
  document.body.dataset.ready = "yes";
})().catch((error) => {
  console.error(error);
  const text = typeof DecompressionStream === "undefined" ? "this browser is too old" : String(error);
  document.querySelector("header").append(Object.assign(document.createElement("p"), { textContent: `The report cannot be shown: ${text}.` }));
});
