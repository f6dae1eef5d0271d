// What the page of a report adds to plotly: zoom and cursor shared by all maps, and the profile under a line.
(() => {
  "use strict";
  const read = id => JSON.parse(document.getElementById(id).textContent);
  const plots = read("plots");
  const plainly = {responsive: true, displayModeBar: false};
  const config = {...plainly, edits: {shapePosition: true}};
  const maps = [...document.querySelectorAll(".plot.map")];
  const draw = (id, options) => Plotly.newPlot(id, plots[id].data, plots[id].layout, options);

  const touch = matchMedia("(pointer: coarse)").matches;
  for (const div of maps) {
    const {data: [trace], layout} = plots[div.id];
    if (trace.meta) trace.text = words(trace);  // the words of a status stand where others have numbers
    if (touch) layout.dragmode = false;  // a finger moves the page; the line still follows it
  }

  function words(trace) {
    const codes = Uint8Array.from(atob(trace.z.bdata), letter => letter.charCodeAt(0));
    const columns = +trace.z.shape.split(",")[1];
    const rows = [];
    for (let start = 0; start < codes.length; start += columns) {
      rows.push(Array.from(codes.subarray(start, start + columns), code => trace.meta[code] || "no layer"));
    }
    return rows;
  }

  // Zoom and line: what is changed in one map is changed in all.
  let line = read("line");
  const ends = ([x0, y0, x1, y1]) => Object.fromEntries([
    ...[0, 1].flatMap(n => Object.entries({x0, y0, x1, y1}).map(([end, at]) => [`shapes[${n}].${end}`, at])),
    ["annotations[0].x", x0], ["annotations[0].y", y0], ["annotations[1].x", x1], ["annotations[1].y", y1]]);
  let echo = false;
  function share(change, source) {
    if (echo) return;
    const moved = Object.keys(change).map(key => key.match(/^shapes\[(\d)\]/)).find(found => found);
    const zoom = Object.fromEntries(Object.entries(change).filter(([key]) => /^[xy]axis\./.test(key)));
    if (moved) line = ["x0", "y0", "x1", "y1"].map(end => source.layout.shapes[moved[1]][end]);
    if (!moved && !Object.keys(zoom).length) return;
    echo = true;
    const all = maps.filter(div => moved || div !== source)
      .map(div => Plotly.relayout(div, moved ? ends(line) : {...zoom}));
    Promise.all(all).finally(() => { echo = false; });
    if (moved) profile();
  }

  // One cursor: every map says its value at the place that one of them is pointed at.
  function point({event, points}, source) {
    if ("xval" in event) return;  // said here, not by the reader
    const at = {xval: points[0].x, yval: points[0].y};
    for (const div of maps) if (div !== source) Plotly.Fx.hover(div, at, "xy");
  }
  function leave(source) {
    for (const div of maps) if (div !== source) Plotly.Fx.unhover(div);
  }

  // The profile: each curve reads its map, bilinearly, at as many points as the map has pixels.
  function value(map, x, y) {
    const {x: xs, y: ys, z} = map;
    const i = (x - xs[0]) / (xs[1] - xs[0]), j = (y - ys[0]) / (ys[1] - ys[0]);
    if (i < -0.5 || j < -0.5 || i > xs.length - 0.5 || j > ys.length - 0.5) return null;
    const left = Math.min(Math.max(Math.floor(i), 0), xs.length - 2);
    const top = Math.min(Math.max(Math.floor(j), 0), ys.length - 2);
    const a = Math.min(Math.max(i - left, 0), 1), b = Math.min(Math.max(j - top, 0), 1);
    const found = (1 - b) * ((1 - a) * z[top][left] + a * z[top][left + 1])
      + b * ((1 - a) * z[top + 1][left] + a * z[top + 1][left + 1]);
    return Number.isFinite(found) ? found : null;
  }
  function profile() {
    const [x0, y0, x1, y1] = line, length = Math.hypot(x1 - x0, y1 - y0), count = 300;
    const along = Array.from({length: count + 1}, (_, n) => n / count);
    const of = key => along.map(t => value(
      document.getElementById("map-" + key)._fullData[0], x0 + t * (x1 - x0), y0 + t * (y1 - y0)));
    const section = document.getElementById("section");
    const ys = section.data.map(({meta}) => {
      const middle = of(meta.map);
      if (!meta.stds) return middle;
      const std = of("uncertainty");
      return middle.map((v, n) => v === null || std[n] === null ? null : v + meta.stds * std[n]);
    });
    Plotly.restyle(section, {x: ys.map(() => along.map(t => t * length)), y: ys});
    const said = [x0, y0, x1, y1].map(v => v.toFixed(2));
    document.getElementById("line-ends").textContent =
      `A (${said[0]}, ${said[1]}) mm to B (${said[2]}, ${said[3]}) mm, ${length.toFixed(2)} mm long`;
  }

  // A page of paper is narrower than a screen: plots are drawn for it while it is printed. An image stands for the
  // layer, which a browser prints blank: it is made ahead, as that takes longer than printing waits.
  const image = document.getElementById("layer-on-paper");
  const copy = async div => { image.src = await Plotly.toImage(div, {format: "png", width: 900, height: 520, scale: 2}); };
  const plotted = Object.keys(plots).filter(id => id !== "layer");
  addEventListener("beforeprint", () => {
    document.body.classList.add("printing");
    for (const id of plotted) {
      const {clientWidth: width, clientHeight: height} = document.getElementById(id);
      Plotly.relayout(id, {width, height});
    }
  });
  addEventListener("afterprint", () => {
    document.body.classList.remove("printing");
    for (const id of plotted) Plotly.relayout(id, {width: null, height: null, autosize: true});
  });

  Promise.all([...maps.map(div => draw(div.id, config)), draw("section", plainly)]).then(() => {
    for (const div of maps) {
      div.on("plotly_relayout", change => share(change, div));
      div.on("plotly_hover", event => point(event, div));
      div.on("plotly_unhover", () => leave(div));
    }
    profile();
    document.querySelectorAll(".plot.more").forEach(div => {
      const {scene} = plots[div.id].layout, narrow = Math.max(1, Math.sqrt(620 / div.clientWidth));
      if (scene) for (const axis of "xyz") scene.camera.eye[axis] *= narrow;  // farther off, so that all of it is seen
      const drawn = draw(div.id, plainly);
      if (div.id === "layer") drawn.then(copy).then(() => div.on("plotly_relayout", () => copy(div)));
    });
    document.documentElement.dataset.ready = "true";
  });
})();
