// Draws the panels of a log: uPlot for lines, a canvas of its own for the allocation and the events.
// Whatever comes from the log reaches the page as text, never as markup.
"use strict";

(async () => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const PIXELS = { axis: 76, right: 18, lines: 168, allocation: 190, lane: 24 };
  const OFF = [232, 235, 239];
  const MOST_ROWS = 200;

  // Numbers.

  async function inflate(text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  const ARRAYS = { float32: Float32Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array };

  // Bytes of the same place in their numbers lie side by side.
  function unpack(bytes, { at, type, count }) {
    const values = new ARRAYS[type](count);
    const out = new Uint8Array(values.buffer);
    const size = values.BYTES_PER_ELEMENT;
    for (let b = 0; b < size; b++)
      for (let i = 0; i < count; i++) out[i * size + b] = bytes[at + b * count + i];
    return values;
  }

  const bytes = await inflate(data.numbers);
  const slots = data.spans.flatMap(([start, count]) => Array.from({ length: count }, (_, i) => start + i));
  const { slot_s, step } = data;
  // Slots of the points of a line: of each `step` slots the first and the middle one.
  const points = [];
  for (let i = 0; i < slots.length; i += step) {
    points.push(slots[i]);
    if (step > 1) points.push(slots[Math.min(i + step / 2, slots.length - 1)]);
  }
  const times = Float64Array.from(points, (slot) => slot * slot_s);
  const full = slots.length
    ? { min: slots[0] * slot_s, max: (slots[slots.length - 1] + 1) * slot_s }
    : { min: 0, max: 1 };
  // Points before which slots are missing.
  const breaks = [];
  for (let i = 1; i < points.length; i++)
    if (points[i] - points[i - 1] > Math.max(1, step)) breaks.push(i);

  // What is looked at.

  let view = { ...full };
  let focused = null; // a user
  const hidden = new Set(); // users
  const charts = []; // {u, host, users, ...}

  const element = (name, text, attributes = {}) => {
    const made = document.createElement(name);
    if (text !== undefined) made.textContent = text;
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  };
  const swatch = (colour) => {
    const made = element("i");
    made.style.background = colour;
    return made;
  };
  const number = (value, digits = 4) =>
    Number.isFinite(value) ? String(+value.toPrecision(digits)).replace("-", "−") : "–";
  const seconds = (value) => value.toFixed(Math.max(2, Math.ceil(-Math.log10(slot_s))));

  function show(min, max) {
    const least = Math.min(4 * slot_s, full.max - full.min);
    const width = Math.min(Math.max(max - min, least), full.max - full.min);
    const start = Math.min(Math.max((min + max - width) / 2, full.min), full.max - width);
    view = { min: start, max: start + width };
    for (const { u } of charts) u.setScale("x", view);
    document.getElementById("span").textContent = `${seconds(view.min)} – ${seconds(view.max)} s`;
    listEvents();
  }

  const zoom = (factor, at = (view.min + view.max) / 2) =>
    show(at - (at - view.min) * factor, at + (view.max - at) * factor);
  const move = (share) => {
    const by = share * (view.max - view.min);
    show(view.min + by, view.max + by);
  };
  const ACTS = {
    in: () => zoom(0.5),
    out: () => zoom(2),
    left: () => move(-0.25),
    right: () => move(0.25),
    all: () => show(full.min, full.max),
  };
  const KEYS = { "+": "in", "-": "out", ArrowLeft: "left", ArrowRight: "right", 0: "all" };

  // One panel: a heading with the values at the cursor, and a chart.

  function panel(title, unit, meaning, height, chart) {
    const host = element("section", undefined, { class: "panel" });
    const head = element("h2", unit ? `${title} [${unit}]` : title);
    head.append(element("span", meaning, { class: "note" }), element("output"));
    host.append(head);
    document.getElementById("panels").append(host);
    host.dataset.title = title;
    const own = { host, readout: head.querySelector("output"), users: null, ...chart };
    own.u = new uPlot(options(own, height), own.values, host);
    charts.push(own);
  }

  function options(own, height) {
    const bind = {
      dblclick: () => () => ACTS.all(),
      mousedown: (u, _, zoomBy) => (event) => (event.shiftKey ? drag(u, event) : zoomBy(event)),
    };
    const pointed = (type) => type === "mousemove" || type === "mouseleave";
    return {
      width: document.getElementById("panels").clientWidth,
      height,
      padding: [8, PIXELS.right, 0, 0],
      legend: { show: false },
      focus: { alpha: 0.2 },
      cursor: {
        bind,
        y: false,
        drag: { x: true, y: false, setScale: false },
        focus: { prox: own.users ? 18 : -1 },
        points: { show: Boolean(own.users), size: 6 },
        sync: { key: "log", filters: { pub: pointed, sub: pointed } },
      },
      scales: { x: { time: false, min: view.min, max: view.max }, y: { range: own.range, ...own.scale } },
      axes: [
        { size: 26, gap: 3, font: "12px system-ui, sans-serif", stroke: "#5b6675", grid: { stroke: "#eceff2" },
          values: (_, splits) => splits.map((t) => `${+t.toFixed(6)} s`) },
        { size: PIXELS.axis, gap: 4, font: "12px system-ui, sans-serif", stroke: "#5b6675",
          grid: { stroke: "#eceff2" }, values: (_, splits) => splits.map((v) => number(v, 6)), ...own.axis },
      ],
      series: [{}, ...own.series],
      hooks: {
        drawClear: [shadeWarmup],
        draw: [own.draw],
        setCursor: [() => read(own)],
        setSelect: [select],
        setSeries: [(u, i, change) => change.focus != null && focus(own, i)],
        setScale: [(u, key) => {
          if (key !== "x") return;
          own.host.dataset.from = u.scales.x.min;
          own.host.dataset.to = u.scales.x.max;
        }],
      },
    };
  }

  function select(u) {
    if (u.select.width > 3) {
      const [from, to] = [u.select.left, u.select.left + u.select.width];
      show(u.posToVal(from, "x"), u.posToVal(to, "x"));
    }
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  }

  function drag(u, event) {
    const { min, max } = view;
    const scale = (max - min) / u.over.clientWidth;
    const moved = ({ clientX }) => {
      const by = (event.clientX - clientX) * scale;
      const kept = Math.min(Math.max(by, full.min - min), full.max - max);
      show(min + kept, max + kept);
    };
    const stop = () => {
      document.removeEventListener("mousemove", moved);
      document.removeEventListener("mouseup", stop);
    };
    document.addEventListener("mousemove", moved);
    document.addEventListener("mouseup", stop);
    event.preventDefault();
  }

  function shadeWarmup(u) {
    const end = Math.min(data.warmup_slots * slot_s, view.max);
    if (end <= view.min) return;
    const { ctx, bbox } = u;
    const right = u.valToPos(end, "x", true);
    ctx.save();
    ctx.fillStyle = "#f4f6f8";
    ctx.fillRect(bbox.left, bbox.top, right - bbox.left, bbox.height);
    ctx.restore();
  }

  function focus(own, line) {
    focused = line == null || !own.users ? null : own.users[line - 1];
    for (const other of charts) read(other);
  }

  function read(own) {
    const { u, readout } = own;
    if (!u) return; // it is being made
    const at = u.cursor.idx;
    readout.replaceChildren();
    if (u.cursor.left < 0 || at == null) return;
    readout.append(`${seconds(times[at])} s, slot ${points[at]}`);
    for (const [name, colour, text] of own.read(at)) readout.append(swatch(colour), `${name}: ${text}`);
  }

  // Lines.

  function lines(given) {
    const all = unpack(bytes, given.numbers);
    const values = Array.from({ length: given.lines }, (_, i) =>
      all.subarray(i * times.length, (i + 1) * times.length));
    const named = given.slices ? data.slices : data.users;
    const users = given.slices ? null : values.map((_, i) => i);
    const gaps = (u) => breaks.map((i) =>
      [i - 1, i].map((place) => u.valToPos(times[place], "x", true)));
    const series = values.map((_, i) => ({
      label: named[i].name, stroke: named[i].colour, width: 1.25, points: { show: false }, gaps,
    }));
    const marks = given.deadlines;
    const range = (_, min, max) => {
      if (min == null || max == null) return [0, 1];
      const high = Math.max(max, ...marks.map((m) => m.value).filter((v, i, a) => v <= 2 * max || v === Math.min(...a)));
      const low = min > 0.5 * max && min !== max ? min : Math.min(0, min);
      const margin = 0.06 * (high - low) || 1;
      return [low === 0 ? 0 : low - margin, high + margin];
    };
    const draw = (u) => {
      for (const { name, value } of marks) ruler(u, name, value);
    };
    const text = (i, at) => {
      const pair = step > 1 ? [at - (at % 2), at - (at % 2) + 1] : [at];
      const shown = pair.map((p) => values[i][p]).sort((a, b) => a - b).map((v) => number(v));
      return `${[...new Set(shown)].join(" to ")} ${given.unit}`.trim();
    };
    const entry = (i, at, lead = "") => [lead + named[i].name, named[i].colour, text(i, at)];
    const read = (at) => {
      if (given.slices) return values.map((_, i) => entry(i, at));
      if (focused != null) return focused < values.length && !hidden.has(focused) ? [entry(focused, at)] : [];
      const shown = users.filter((i) => !hidden.has(i));
      if (!shown.length) return [];
      return [entry(shown.reduce((a, b) => (values[b][at] > values[a][at] ? b : a)), at, "greatest, ")];
    };
    panel(given.title, given.unit, given.meaning, PIXELS.lines, {
      users, series, values: [times, ...values], range, draw, read,
    });
  }

  function ruler(u, name, value) {
    const { ctx, bbox } = u;
    const y = u.valToPos(value, "y", true);
    if (y < bbox.top) return;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = "#1c2430";
    ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    ctx.lineWidth = devicePixelRatio;
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textAlign = "right";
    ctx.strokeStyle = "#fff";
    ctx.setLineDash([]);
    ctx.lineWidth = 4 * devicePixelRatio;
    const place = [bbox.left + bbox.width - 6 * devicePixelRatio, y - 5 * devicePixelRatio];
    ctx.strokeText(name, ...place);
    ctx.fillText(name, ...place);
    ctx.restore();
  }

  // The allocation.

  const rgb = (colour) => [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));

  function allocation({ title, unit, prbs, numbers }) {
    const owner = unpack(bytes, numbers); // a row a slot
    const rows = [];
    for (let i = 0; i < slots.length; i += step) rows.push(slots[i]);
    const colours = data.users.map((user) => rgb(user.colour));
    // The first row that ends behind a time.
    const rowAt = (time) => {
      let [low, high] = [0, rows.length];
      while (low < high) {
        const middle = (low + high) >> 1;
        if ((rows[middle] + step) * slot_s > time) high = middle;
        else low = middle + 1;
      }
      return low;
    };
    const draw = (u) => {
      const { ctx, bbox } = u;
      const width = Math.round(bbox.width);
      const image = new ImageData(width, prbs);
      const count = new Uint32Array(data.users.length);
      const per = (view.max - view.min) / width;
      for (let x = 0; x < width; x++) {
        const [from, to] = [view.min + x * per, view.min + (x + 1) * per];
        const first = rowAt(from);
        let last = first;
        while (last < rows.length && rows[last] * slot_s < to) last++;
        if (last === first) continue; // slots are missing there
        for (let k = 0; k < prbs; k++) {
          // Who has had the PRB most often in the slots of this column.
          count.fill(0);
          let most = owner[first * prbs + k];
          for (let row = first; row < last; row++) {
            const user = owner[row * prbs + k];
            if (++count[user] > count[most]) most = user;
          }
          image.data.set([...(hidden.has(most) ? OFF : colours[most]), 255], 4 * (k * width + x));
        }
      }
      const small = new OffscreenCanvas(width, prbs);
      small.getContext("2d").putImageData(image, 0, 0);
      ctx.save();
      ctx.imageSmoothingEnabled = false;
      ctx.drawImage(small, bbox.left, bbox.top, width, bbox.height);
      ctx.restore();
    };
    const read = () => {
      const { u } = charts.find((chart) => chart.draw === draw);
      if (!(u.cursor.top >= 0) || !u.over.matches(":hover")) return [];
      const row = Math.min(rowAt(u.posToVal(u.cursor.left, "x")), rows.length - 1);
      const k = Math.min(prbs - 1, Math.floor(u.posToVal(u.cursor.top, "y")));
      const user = data.users[owner[row * prbs + k]];
      return [[`PRB ${k}`, user.colour, user.name]];
    };
    const meaning = "who has each PRB; where a column of pixels is of several slots, who has it most often";
    panel(title, unit, meaning, PIXELS.allocation, {
      series: [{ show: false }], values: [times, new Uint8Array(times.length)],
      range: () => [0, prbs], scale: { dir: -1 }, draw, read,
      axis: { grid: { show: false }, incrs: [1, 2, 5, 10, 20, 50, 100] },
    });
  }

  // Events.

  const inView = () => data.events.filter(([slot, , , user]) => {
    const time = slot * slot_s;
    return time >= view.min && time < view.max && !hidden.has(user);
  });

  function eventStrip() {
    const kinds = [...new Set(data.events.map(([, , name]) => name))].sort();
    const draw = (u) => {
      const { ctx, bbox } = u;
      const lane = bbox.height / kinds.length;
      ctx.save();
      for (const [slot, , name, user] of inView()) {
        ctx.fillStyle = user in data.users ? data.users[user].colour : "#1c2430";
        const top = bbox.top + kinds.indexOf(name) * lane;
        const x = u.valToPos(slot * slot_s, "x", true);
        ctx.fillRect(x, top + 0.12 * lane, 2 * devicePixelRatio, 0.76 * lane);
      }
      ctx.restore();
    };
    panel("Events", "", "where each trouble begins; the table below has those in view", 40 + PIXELS.lane * kinds.length, {
      series: [{ show: false }], values: [times, new Uint8Array(times.length)],
      range: () => [0, kinds.length], scale: { dir: -1 }, draw, read: () => [],
      axis: { grid: { show: false }, ticks: { show: false }, splits: () => kinds.map((_, i) => i + 0.5),
              values: () => kinds },
    });
  }

  function listEvents() {
    const found = inView();
    const body = document.querySelector("#events tbody");
    body.replaceChildren(...found.slice(0, MOST_ROWS).map(([slot, level, name, user, message]) => {
      const row = element("tr");
      row.append(element("td", seconds(slot * slot_s), { class: "number" }),
                 element("td", slot, { class: "number" }));
      const who = element("td");
      if (user in data.users) who.append(swatch(data.users[user].colour), data.users[user].name);
      row.append(who, element("td", name), element("td", level.toLowerCase()), element("td", message));
      row.addEventListener("click", () => show(slot * slot_s - 1, slot * slot_s + 1));
      return row;
    }));
    const first = found.length > MOST_ROWS ? `the first ${MOST_ROWS} of ` : "";
    document.getElementById("events-shown").textContent =
      `Between ${seconds(view.min)} and ${seconds(view.max)} s, of users that are shown: ${first}${found.length} ` +
      `(${data.events.length} in all). A click on one shows a second on either side of it.`;
  }

  // Users: a click hides one in every panel.

  function toggle(users, on) {
    for (const user of users) on ? hidden.delete(user) : hidden.add(user);
    for (const button of document.querySelectorAll("#users button[data-user]"))
      button.setAttribute("aria-pressed", String(!hidden.has(+button.dataset.user)));
    data.slices.forEach((_, slice) => {
      const group = document.querySelector(`#users button[data-slice="${slice}"]`);
      if (group) group.setAttribute("aria-pressed", String(ofSlice(slice).some((user) => !hidden.has(user))));
    });
    for (const own of charts) draw(own);
    listEvents();
  }

  const ofSlice = (slice) => data.users.flatMap((user, i) => (user.slice === slice ? [i] : []));

  function draw(own) {
    const { u } = own;
    u.batch(() => {
      if (own.users) own.users.forEach((user) => u.setSeries(user + 1, { show: !hidden.has(user) }, false));
      else if (own.series.length === 2)
        own.series.forEach((_, slice) =>
          u.setSeries(slice + 1, { show: ofSlice(slice).some((user) => !hidden.has(user)) || !ofSlice(slice).length }, false));
    });
    u.redraw(false, false);
    own.host.dataset.shown = u.series.slice(1).flatMap((line) => (line.show && line.label ? [line.label] : [])).join(",");
  }

  function highlight(user) {
    focused = user;
    for (const own of charts) {
      if (own.users && (user == null || user < own.users.length))
        own.u.setSeries(user == null ? null : user + 1, { focus: true }, false);
      read(own);
    }
  }

  function legend() {
    data.slices.forEach(({ name, colour }, slice) => {
      const users = ofSlice(slice);
      if (!users.length) return;
      const row = element("div", undefined, { class: "slice" });
      const all = element("button", undefined, {
        type: "button", "data-slice": slice, "aria-pressed": "true", title: `hide or show all ${name} users`,
      });
      all.append(swatch(colour), name);
      all.addEventListener("click", () => toggle(users, users.every((user) => hidden.has(user))));
      row.append(all);
      for (const user of users) {
        const button = element("button", undefined, { type: "button", "data-user": user, "aria-pressed": "true" });
        button.append(swatch(data.users[user].colour), data.users[user].name);
        button.addEventListener("click", () => toggle([user], hidden.has(user)));
        button.addEventListener("mouseenter", () => highlight(user));
        button.addEventListener("mouseleave", () => highlight(null));
        row.append(button);
      }
      document.getElementById("users").append(row);
    });
  }

  // The page.

  const fill = (id, pairs) => {
    for (const [name, text] of pairs)
      document.getElementById(id).append(element("dt", name), element("dd", text));
  };
  document.getElementById("title").textContent = data.title;
  fill("about", data.about);
  fill("metadata", data.metadata);
  if (data.warmup_slots)
    data.notes.unshift(`Grey: the warm-up, ${data.warmup_slots} slots that no table counts.`);
  for (const note of data.notes) document.getElementById("notes").append(element("li", note));
  legend();
  if (slots.length) {
    for (const given of data.panels) given.prbs ? allocation(given) : lines(given);
    if (data.events.length) eventStrip();
    show(full.min, full.max);
    toggle([], true);
  }

  document.getElementById("view").addEventListener("click", ({ target }) => {
    if (target.dataset.act) ACTS[target.dataset.act]();
  });
  document.addEventListener("keydown", (event) => {
    if (event.key in KEYS && !event.ctrlKey && !event.metaKey && !event.altKey) {
      ACTS[KEYS[event.key]]();
      event.preventDefault();
    }
  });
  document.getElementById("panels").addEventListener("wheel", (event) => {
    const own = charts.find((chart) => chart.host.contains(event.target));
    if (!own || !event.ctrlKey) return;
    event.preventDefault();
    const left = event.clientX - own.u.over.getBoundingClientRect().left;
    zoom(event.deltaY > 0 ? 1.25 : 0.8, own.u.posToVal(left, "x"));
  }, { passive: false });

  const fit = (width) => {
    for (const { u } of charts) if (u.width !== width) u.setSize({ width, height: u.height });
  };
  new ResizeObserver(([entry]) => fit(Math.floor(entry.contentRect.width))).observe(document.getElementById("panels"));
  addEventListener("beforeprint", () => fit(1000));
  addEventListener("afterprint", () => fit(document.getElementById("panels").clientWidth));
  document.body.dataset.ready = "yes";
})().catch((error) => {
  document.getElementById("title").textContent = `This browser cannot draw the page: ${error.message}`;
  throw error;
});
