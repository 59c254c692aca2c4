// Measures a page as it is drawn. Everything in CSS pixels of the screen, after zoom, viewport and SVG transforms.
() => {
  const phone = window.visualViewport.scale;
  const round = (v) => Math.round(v * 100) / 100;
  const box = (r) => ({ x: r.left + scrollX, y: r.top + scrollY, w: r.width, h: r.height });
  const where = (e) => {
    const named = e.closest("[id]");
    return `${named && named !== document.body ? "#" + named.id + " " : ""}${e.tagName.toLowerCase()}`;
  };
  const factor = (e) => {
    if (e instanceof SVGElement) {
      const m = e.getScreenCTM();
      return Math.sqrt(Math.abs(m.a * m.d - m.b * m.c));
    }
    let f = 1;
    for (let p = e; p; p = p.parentElement) {
      const m = new DOMMatrix(getComputedStyle(p).transform);
      f *= Math.sqrt(Math.abs(m.a * m.d - m.b * m.c));
    }
    return f;
  };
  const texts = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode, e = node.parentElement;
    if (!node.data.trim() || e.closest("script, style, noscript, template, title")) continue;
    if (!e.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const r = range.getBoundingClientRect();
    if (r.width < 1 || r.height < 1) continue;
    const style = getComputedStyle(e), svg = e.closest("svg");
    texts.push({
      text: node.data.trim().slice(0, 40), where: where(e), px: round(parseFloat(style.fontSize) * factor(e) * phone),
      svg: svg !== null, box: box(r), colour: svg ? style.fill : style.color,
      opacity: parseFloat(style.opacity) * (svg ? parseFloat(style.fillOpacity) : 1), picture: svg && box(svg.getBoundingClientRect()),
      index: svg ? [...document.querySelectorAll("svg")].indexOf(svg) : -1,
    });
  }
  const sheet = document.documentElement;
  const wide = [...document.querySelectorAll("body *")].filter((e) => {
    const r = e.getBoundingClientRect();
    if (r.width === 0 || r.right <= sheet.clientWidth + 1 || e.closest("svg") !== null && e.tagName !== "svg") return false;
    for (let p = e.parentElement; p && p !== document.body; p = p.parentElement) {
      if (/auto|scroll|hidden|clip/.test(getComputedStyle(p).overflowX)) return false;
    }
    return true;
  });
  const strokes = [...document.querySelectorAll("figure svg path:not(.grid), .js-plotly-plot path.js-line")]
    .filter((e) => e.checkVisibility() && getComputedStyle(e).stroke !== "none" && e.getTotalLength() > 20)
    .map((e) => ({ where: where(e), colour: getComputedStyle(e).stroke, box: box(e.closest("svg").getBoundingClientRect()) }));
  const figures = [...document.querySelectorAll("figure, .js-plotly-plot, figure .panel, table, tr")].map((e) => ({
    where: where(e) + (e.dataset.figure ? `[${e.dataset.figure}]` : ""), height: round(e.getBoundingClientRect().height),
    inside: getComputedStyle(e).breakInside, kind: { TR: "row", TABLE: "table", DIV: "panel" }[e.tagName] ?? "figure",
  }));
  const broken = [];
  for (const cell of document.querySelectorAll("td, th")) {
    if (!cell.checkVisibility()) continue;
    const cells = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
    while (cells.nextNode()) {
      for (const word of cells.currentNode.data.matchAll(/[\w.]+/g)) {
        const range = document.createRange();
        range.setStart(cells.currentNode, word.index);
        range.setEnd(cells.currentNode, word.index + word[0].length);
        if (new Set([...range.getClientRects()].map((r) => Math.round(r.top))).size > 1) broken.push(word[0]);
      }
    }
  }
  const bare = document.body.cloneNode(true);
  bare.querySelectorAll("figure, script, style").forEach((e) => e.remove());
  return {
    texts, broken, strokes, figures, wide: wide.slice(0, 5).map(where), scroll: sheet.scrollWidth - sheet.clientWidth, phone,
    width: sheet.clientWidth, scrolled: sheet.scrollWidth,
    captions: [...document.querySelectorAll("figcaption")].map((e) => e.innerText), outside: bare.textContent,
  };
}
