"use strict";
(async () => {
  const unpacked = async (id) => {
    const text = document.getElementById(id).textContent; // seven bits a character
    const bytes = new Uint8Array((text.length * 7) >> 3);
    for (let k = 0, held = 0, count = 0, at = 0; k < text.length; k++) {
      held = ((held << 7) | (text.charCodeAt(k) & 127)) & 0x7fff;
      count += 7;
      if (count >= 8) bytes[at++] = held >> (count -= 8);
    }
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const plotly = document.createElement("script");
  plotly.textContent = await unpacked("plotly"); // runs at once: the page's policy names its digest
  document.head.append(plotly);
  const { figures, drive } = JSON.parse(await unpacked("figures"));
  const movers = []; // [plot, moves it to a step of the drive]
  for (const [key, figure] of Object.entries(figures)) {
    // By name, so that no button of a later Plotly that would send data away gets in.
    const buttons = figure.layout.scene
      ? ["toImage", "resetCameraDefault3d"]
      : ["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"];
    const config = { responsive: true, displaylogo: false, modeBarButtons: [buttons] };
    const axes = { above: ["x", "y"], map: ["x", "y", "z"] }[key];
    if (drive && axes) {
      const marker = { color: drive.colours, size: axes.length === 2 ? 12 : 8, line: { color: "#1b1f24", width: 2 } };
      const type = axes.length === 2 ? "scatter" : "scatter3d";
      const none = Object.fromEntries(axes.map((axis) => [axis, [null]]));
      figure.data.push({ type, mode: "markers", name: "now", showlegend: false, hoverinfo: "skip", marker, ...none });
    }
    const plot = await Plotly.newPlot(`plot-${key}`, { ...figure, config });
    if (drive && axes) {
      const place = (k) => (axis, i) => [axis, [drive.places.map((path) => path[k][i])]];
      movers.push([plot, (k) => Plotly.restyle(plot, Object.fromEntries(axes.map(place(k))), [figure.data.length - 1])]);
    } else if (drive && figure.layout.xaxis?.title?.text?.startsWith("time")) {
      const line = (x) => ({ type: "line", x0: x, x1: x, yref: "paper", y0: 0, y1: 1, line: { color: "#59616b", width: 1 } });
      movers.push([plot, (k) => Plotly.relayout(plot, { shapes: [line(drive.seconds[k])] })]);
    }
  }
  if (drive) {
    const [step, when, view] = ["step", "when", "view"].map((id) => document.getElementById(id));
    const inSight = (plot) => {
      const { top, bottom } = plot.getBoundingClientRect();
      return bottom > 0 && top < innerHeight;
    };
    let waits = false;
    const move = () => {
      waits = false;
      const k = Number(step.value);
      when.value = `${drive.seconds[k].toFixed(2)} s`;
      const seen = drive.views.findLast(([from]) => from <= k);
      if (seen && view.src !== seen[1]) view.src = seen[1];
      view.hidden = !seen;
      for (const mover of movers) {
        if (mover[2] === k || !inSight(mover[0])) continue;
        mover[2] = k;
        mover[1](k);
      }
    };
    const soon = () => {
      if (!waits) requestAnimationFrame(move);
      waits = true;
    };
    step.addEventListener("input", soon);
    addEventListener("scroll", () => document.documentElement.dataset.moved && soon(), { passive: true });
    step.addEventListener("input", () => (document.documentElement.dataset.moved = "yes"), { once: true });
    document.querySelector(".along").hidden = false;
    move();
  }
  document.documentElement.dataset.drawn = "yes";
})();
