"use strict";
// Shows the value under the pointer, or under a tap, in the figures of the page; without it the page is whole.
(() => {
  const REACH = 40, REACH_IN_MAP = 8; // pixels from the pointer to the nearest point
  const sign = document.createElement("div");
  sign.className = "reading";
  sign.hidden = true;
  document.body.append(sign);
  let ring = null;

  const hide = () => { sign.hidden = true; ring?.remove(); ring = null; };

  const corners = (group) => {
    const dy = +(group.querySelector("use")?.getAttribute("y") ?? 0);
    return [...group.querySelectorAll("path")].flatMap((path) =>
      [...path.getAttribute("d").matchAll(/[ML] (\S+) (\S+)/g)].map((found) => [+found[1], +found[2] + dy]));
  };
  const marks = (group) => [...group.querySelectorAll("use")].map((use) => [+use.getAttribute("x"), +use.getAttribute("y")]);

  const readPanel = (group) => {
    const panel = JSON.parse(group.dataset.axes);
    panel.series = [...group.querySelectorAll("[data-series]")].map((one) => {
      const [name, colour] = JSON.parse(one.dataset.series), found = marks(one);
      return { name, colour, points: found.length ? found : corners(one) };
    });
    panel.spreads = [...group.querySelectorAll("[data-spread]")].map((one) => ({ colour: one.dataset.spread, points: corners(one) }));
    return panel;
  };

  const value = ({ limits: [low, high], log, texts, unlabelled }, part) => {
    if (unlabelled) return "";
    if (log) return String(+(low * (high / low) ** part).toPrecision(3));
    const found = low + part * (high - low);
    if (texts) return texts.reduce((best, one) => (Math.abs(one[0] - found) < Math.abs(best[0] - found) ? one : best))[1];
    return String(+found.toFixed(Math.max(0, 3 - Math.floor(Math.log10(Math.abs(high - low))))));
  };
  const across = ({ x, box: [left, right] }, at) => value(x, (at - left) / (right - left));
  const upwards = ({ y, box: [, , bottom, top] }, at) => value(y, (bottom - at) / (bottom - top));

  const text = (panel, { name, colour }, [x, y]) => {
    const heights = panel.spreads.filter((one) => one.colour === colour).map((one) =>
      one.points.filter(([at]) => Math.abs(at - x) < 0.05).map(([, at]) => at));
    const spreads = heights.filter((all) => all.length > 1).map((all) =>
      ` (${upwards(panel, Math.max(...all))} to ${upwards(panel, Math.min(...all))})`);
    return [
      [panel.title, name].filter(Boolean).join(": "),
      [panel.x.name, across(panel, x)].filter(Boolean).join(": "),
      [panel.y.name, upwards(panel, y)].filter(Boolean).join(": ") + [...new Set(spreads)].join(""),
    ].filter(Boolean).join("\n");
  };

  const inMap = ({ title, x, y, maps }, right, up) => {
    const cell = ({ limits: [low, high] }, edges, part) => {
      const at = low + part * (high - low), found = edges.findIndex((edge, k) => (at - edge) * (at - edges[k + 1]) <= 0);
      return [found, ((edges[found] + edges[found + 1]) / 2 - low) / (high - low)];
    };
    for (const map of maps) {
      const [i, across] = cell(x, map.x, right), [j, above] = cell(y, map.y, up), held = map.values[j]?.[i];
      if (held == null) continue;
      return [title, [x.name, value(x, across)].filter(Boolean).join(": "), [y.name, value(y, above)].filter(Boolean).join(": "),
        `${map.name}: ${held}`].filter(Boolean).join("\n");
    }
    return "";
  };

  const mark = (svg, [x, y], scale) => {
    ring = document.createElementNS(svg.namespaceURI, "circle");
    for (const [key, of] of Object.entries({ class: "ring", cx: x, cy: y, r: 4 / scale })) ring.setAttribute(key, of);
    svg.append(ring);
  };

  const show = (svg, panels, event) => {
    const matrix = svg.getScreenCTM(), pointer = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix.inverse());
    let best = null, least = REACH / matrix.a, cell = "";
    for (const panel of panels) {
      const [left, right, bottom, top] = panel.box;
      if (pointer.x < left - 4 || pointer.x > right + 4 || pointer.y > bottom + 4 || pointer.y < top - 4) continue;
      cell = inMap(panel, (pointer.x - left) / (right - left), (bottom - pointer.y) / (bottom - top));
      if (cell) least = Math.min(least, REACH_IN_MAP / matrix.a);
      for (const series of panel.series) for (const point of series.points) {
        const distance = Math.hypot(point[0] - pointer.x, point[1] - pointer.y);
        if (distance <= least) { least = distance; best = { panel, series, point }; }
      }
    }
    hide();
    if (!best && !cell) return;
    sign.textContent = best ? text(best.panel, best.series, best.point) : cell;
    sign.hidden = false;
    if (best) mark(svg, best.point, matrix.a);
    const { width, height } = sign.getBoundingClientRect(), end = document.documentElement.clientWidth - width - 8;
    sign.style.left = `${Math.max(8, Math.min(event.clientX + 14, end))}px`;
    sign.style.top = `${event.clientY > height + 24 ? event.clientY - height - 14 : event.clientY + 20}px`;
  };

  for (const svg of document.querySelectorAll("figure svg:has([data-axes]), svg[data-drawing]")) {
    // A tile shows a part of a drawing in the coordinates of the whole.
    const drawing = document.getElementById(svg.dataset.drawing) ?? svg;
    let panels = null;
    const look = (event) => {
      panels ??= [...drawing.querySelectorAll("[data-axes]")].map(readPanel);
      show(svg, panels, event);
      event.stopPropagation();
    };
    svg.addEventListener("pointermove", look);
    svg.addEventListener("pointerdown", look);
    svg.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") hide(); });
  }
  document.addEventListener("pointerdown", hide);
  document.addEventListener("scroll", hide, true);
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") hide(); });
})();
