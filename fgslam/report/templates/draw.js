"use strict";
(async () => {
  const unpacked = async (id) => {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const plotly = document.createElement("script");
  plotly.textContent = await unpacked("plotly"); // runs at once: the page's policy names its digest
  document.head.append(plotly);
  for (const [key, figure] of Object.entries(JSON.parse(await unpacked("figures")))) {
    // By name, so that no button of a later Plotly that would send data away gets in.
    const buttons = figure.layout.scene
      ? ["toImage", "resetCameraDefault3d"]
      : ["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"];
    const config = { responsive: true, displaylogo: false, modeBarButtons: [buttons] };
    await Plotly.newPlot(`plot-${key}`, { ...figure, config });
  }
  document.documentElement.dataset.drawn = "yes";
})();
