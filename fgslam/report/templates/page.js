"use strict";
// Draws the figures of a report and keeps them in step with the page's switches and colours.
// The switches themselves are the only state: a figure is always drawn from what they say.
(async () => {
  // Compressed text of an element of this page.
  async function unpacked(id) {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }

  if (typeof DecompressionStream === "undefined") {
    document.getElementById("undrawn").hidden = false;
    return;
  }
  const figures = JSON.parse(await unpacked("report-data"));
  const colours = Number(document.getElementById("report-data").dataset.colours);
  const plotly = document.createElement("script");
  plotly.textContent = await unpacked("plotly"); // runs at once: the page's policy names its digest
  document.head.append(plotly);

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const touch = matchMedia("(pointer: coarse)");
  const narrow = matchMedia("(max-width: 600px)");

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const switchOf = (figure, key) =>
    document.querySelector(`input[data-figure="${figure}"][data-switch="${key}"]`);
  const isOn = (figure, key) => switchOf(figure, key)?.checked ?? false;
  const estimatorOn = (i) => document.querySelector(`input[data-estimator="${i}"]`)?.checked ?? true;
  const chosenIn = (figure) => {
    const select = document.querySelector(`select[data-figure="${figure}"]`);
    return select === null ? null : Number(select.value);
  };

  const sliderOf = (figure) => document.querySelector(`input[type=range][data-figure="${figure}"]`);
  const stepIn = (figure) => Number(sliderOf(figure)?.value ?? 0);

  function isVisible(figure, owner) {
    const asked = owner.when.every((key) => isOn(figure, key));
    if (!asked || owner.unless.some((key) => isOn(figure, key))) return false;
    if (owner.chosen) return chosenIn(figure) === owner.estimator;
    return owner.estimator === null || estimatorOn(owner.estimator);
  }

  function colourOf(owner) {
    if (owner.paint === "truth") return css("--ink");
    if (owner.paint === "grey") return css("--dots");
    return css(`--e${(owner.colour ?? owner.estimator) % colours}`);
  }

  function dressedTrace(figure, trace) {
    const owner = trace.meta;
    const dressed = { ...trace, visible: isVisible(figure, owner), showlegend: false };
    if (owner.paint === "own") return dressed;
    if (owner.paint === "band") return { ...dressed, fillcolor: css("--band") };
    if (trace.line) dressed.line = { ...trace.line, color: colourOf(owner) };
    if (trace.marker) dressed.marker = { ...trace.marker, color: colourOf(owner) };
    return dressed;
  }

  function dressedAxis(axis, isFlat) {
    const grid = { gridcolor: css("--grid"), zerolinecolor: css("--axis"), linecolor: css("--axis") };
    const flat = isFlat
      ? { automargin: true, fixedrange: touch.matches }
      : { backgroundcolor: css("--paper"), showbackground: false };
    return { ...grid, ...flat, ...axis, title: { ...axis.title, font: { size: 13 } } };
  }

  function dressedLayout(key, layout) {
    const dressed = {
      ...layout,
      uirevision: "kept", // zoom and camera outlive a redraw
      showlegend: false,
      autosize: true,
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: "system-ui, sans-serif", size: 12, color: css("--ink") },
      margin: { l: 8, r: 12, t: 8, b: 8 },
      hoverlabel: { bgcolor: css("--paper"), bordercolor: css("--axis"), font: { color: css("--ink") } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: css("--faint"), activecolor: css("--ink") },
    };
    if (layout.scene) {
      dressed.margin = { l: 0, r: 0, t: 0, b: 0 };
      dressed.scene = { ...layout.scene, uirevision: "kept" };
      for (const axis of ["xaxis", "yaxis", "zaxis"])
        dressed.scene[axis] = dressedAxis(layout.scene[axis], false);
      return dressed;
    }
    for (const name of Object.keys(layout).filter((name) => /^[xy]axis/.test(name)))
      dressed[name] = dressedAxis(layout[name], true);
    const log = switchOf(key, "log");
    if (log !== null) dressed.yaxis.type = log.checked ? "log" : "linear";
    dressed.yaxis.exponentformat = "power"; // not 100µ, beside a unit of its own
    dressed.yaxis.uirevision = dressed.yaxis.type; // a linear range means nothing on the other scale
    dressed.dragmode = touch.matches ? false : "zoom";
    return dressed;
  }

  function draw(key) {
    const { traces, layout } = figures[key];
    const config = {
      responsive: true,
      displaylogo: false,
      displayModeBar: narrow.matches ? false : "hover",
      // By name, so that no button of a later Plotly that would send data away gets in.
      modeBarButtons: layout.scene
        ? [["toImage", "resetCameraDefault3d"]]
        : [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
    };
    // What belongs to another moment is not even handed over: there may be thousands.
    const now = traces.filter(({ meta }) => meta.step === undefined || meta.step === stepIn(key));
    const dressed = now.map((trace) => dressedTrace(key, trace));
    return Plotly.react(`plot-${key}`, dressed, dressedLayout(key, layout), config);
  }

  const drawAll = () => Promise.all(Object.keys(figures).map(draw));

  document.addEventListener("change", (event) => {
    const { figure, estimator } = event.target.dataset;
    if (event.target.type === "range") return; // has been drawn while it moved
    if (estimator !== undefined) drawAll();
    else if (figure !== undefined) draw(figure);
  });
  for (const query of [dark, touch, narrow]) query.addEventListener("change", drawAll);

  function showMoment(slider) {
    const moments = slider.closest(".moments");
    moments.querySelector("output").textContent = JSON.parse(slider.dataset.steps)[slider.value];
    return draw(slider.dataset.figure);
  }

  document.addEventListener("input", (event) => {
    if (event.target.type === "range") showMoment(event.target);
  });
  for (const button of document.querySelectorAll("button[data-play]")) {
    const slider = sliderOf(button.dataset.play);
    let playing = 0; // which press of the button runs; 0: none
    let presses = 0;
    const stop = () => { playing = 0; button.textContent = "Play"; };
    button.addEventListener("click", async () => {
      if (playing) return stop();
      const own = (playing = ++presses);
      button.textContent = "Stop";
      if (slider.value === slider.max) slider.value = 0;
      while (playing === own && Number(slider.value) < Number(slider.max)) {
        slider.value = Number(slider.value) + 1;
        await showMoment(slider);
        await new Promise((next) => setTimeout(next, 120));
      }
      if (playing === own) stop();
    });
  }

  // Maps turn by arrow keys, too, and come closer by plus and minus.
  const TURN = { ArrowLeft: [0.1, 1], ArrowRight: [-0.1, 1], "+": [0, 0.9], "-": [0, 1.1] };
  const RAISE = { ArrowUp: 0.15, ArrowDown: -0.15 };
  for (const plot of document.querySelectorAll(".plot[tabindex]")) {
    plot.addEventListener("keydown", (event) => {
      if (!(event.key in TURN) && !(event.key in RAISE)) return;
      event.preventDefault();
      const camera = plot._fullLayout.scene._scene.getCamera();
      const [angle, nearer] = TURN[event.key] ?? [0, 1];
      const { x, y, z } = camera.eye;
      const eye = {
        x: nearer * (x * Math.cos(angle) - y * Math.sin(angle)),
        y: nearer * (x * Math.sin(angle) + y * Math.cos(angle)),
        z: nearer * z + (RAISE[event.key] ?? 0),
      };
      Plotly.relayout(plot, { "scene.camera": { ...camera, eye } });
    });
  }

  const dialog = document.getElementById("closer");
  for (const button of document.querySelectorAll("button.enlarge")) {
    button.addEventListener("click", () => {
      const image = button.querySelector("img");
      dialog.querySelector("img").src = image.src;
      dialog.querySelector("img").alt = image.alt;
      dialog.querySelector("p").textContent = image.alt;
      dialog.showModal();
    });
  }
  dialog.querySelector("button").addEventListener("click", () => dialog.close());

  await drawAll();
  document.documentElement.setAttribute("data-drawn", "yes");
})();
