"""What is asked of every page, in the page itself: contrast, overlaps, and what Tab reaches."""

CONTROLS = (
    "a[href], button, input:not([type=file]), select, textarea, summary, .q-checkbox, .q-slider, .modebar-btn, "
    "[tabindex='0']"
)

CONTRAST = """() => {
  const none = [0, 0, 0, 0];
  const parse = (c) => { const m = c.match(/[\\d.]+/g)?.map(Number) ?? none; return m.length < 4 ? [...m, 1] : m; };
  const over = (a, b) => a.slice(0, 3).map((v, k) => v * a[3] + b[k] * (1 - a[3]));
  const part = (v) => v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
  const light = (c) => [.2126, .7152, .0722].reduce((sum, f, k) => sum + f * part(c[k] / 255), 0);
  const ratio = (a, b) => { const [x, y] = [light(a), light(b)].sort((p, q) => q - p); return (x + .05) / (y + .05); };
  const ground = (e) => {
    if (!e) return [255, 255, 255];
    const own = parse(getComputedStyle(e).backgroundColor);
    const plot = e.matches(".js-plotly-plot .main-svg") ? parse(e.style.background) : none;
    const c = plot[3] ? plot : own;
    return c[3] > .99 ? c.slice(0, 3) : over(c, ground(e.parentElement));
  };
  const opacity = (e) => e ? Number(getComputedStyle(e).opacity) * opacity(e.parentElement) : 1;
  const seen = (e) => e.checkVisibility({ visibilityProperty: true }) && e.getBoundingClientRect().width > 0;
  const out = [];
  const judge = (e, text, colour, least) => {
    const under = ground(e), c = parse(colour);
    if (c[3] === 0) return; // not shown now
    const r = ratio(over([...c.slice(0, 3), c[3] * opacity(e)], under), under);
    if (r < least) out.push(`${text.trim().slice(0, 40)}: ${r.toFixed(2)}`);
  };
  for (const e of document.querySelectorAll("body *")) {
    const own = [...e.childNodes].filter((n) => n.nodeType === 3).map((n) => n.textContent).join("").trim();
    const drawn = e.tagName === "text" || e.tagName === "tspan";
    if (own && !["STYLE", "SCRIPT"].includes(e.tagName) && seen(e)) {
      const style = getComputedStyle(e), size = parseFloat(style.fontSize);
      const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
      const icon = e.classList.contains("q-icon");
      judge(e, own, drawn ? style.fill : style.color, large || icon ? 3 : 4.5);
    }
    if (e.placeholder && !e.value && seen(e)) judge(e, e.placeholder, getComputedStyle(e, "::placeholder").color, 4.5);
    if (e.classList.contains("q-field__control") && seen(e))
      judge(e.parentElement, "edge of a field", getComputedStyle(e, "::before").borderTopColor, 3);
  }
  return [...new Set(out)];
}"""
"""WCAG 2.1, 1.4.3 and 1.4.11: texts that have less than 4.5, large ones, icons and edges of fields less than 3."""

OVERLAPS = """(controls) => {
  const all = [...document.querySelectorAll(controls)].filter((e) => e.checkVisibility({ visibilityProperty: true })
    && !e.closest(".q-uploader__input, .modebar"));
  const boxes = all.map((e) => [e, e.getBoundingClientRect()]).filter(([, r]) => r.width > 0 && r.height > 0);
  const name = (e) => `${e.tagName} ${(e.getAttribute("aria-label") || e.textContent).trim().slice(0, 30)}`;
  const out = [];
  boxes.forEach(([a, p], i) => {
    for (const [b, q] of boxes.slice(i + 1)) {
      if (a.contains(b) || b.contains(a) || a.closest(".q-field") === (b.closest(".q-field") ?? 0)) continue;
      const wide = Math.min(p.right, q.right) - Math.max(p.left, q.left);
      const high = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
      if (wide > 1 && high > 1) out.push(`${name(a)} over ${name(b)}`);
    }
  });
  for (const [e, r] of boxes) {
    if (r.left < -1 || (r.right > innerWidth + 1 && !e.closest(".scroll"))) out.push(`${name(e)} out of the window`);
    if (Math.min(r.width, r.height) < 24 && !e.closest("p, td, .q-field")) out.push(`${name(e)} smaller than 24 px`);
    if (e.tagName === "BUTTON" && e.scrollWidth > e.clientWidth + 1) out.push(`${name(e)} cut off`);
  }
  return [...new Set(out)];
}"""
"""Pairs of controls that overlap; what is out of the window, cut off, or too small for a finger (WCAG 2.5.8)."""

FOCUS = """() => {
  const e = document.activeElement;
  if (!e || e === document.body) return null;
  const ring = [e, e.closest(".q-field__control"), e.querySelector(".q-slider__focus-ring")].filter(Boolean)
    .some((x) => { const s = getComputedStyle(x);
      return (s.outlineStyle !== "none" && parseFloat(s.outlineWidth) >= 2) || s.boxShadow !== "none"; });
  const r = e.getBoundingClientRect();
  const inside = r.bottom > 0 && r.top < innerHeight && r.width > 0;
  const name = (e.getAttribute("aria-label") || e.textContent || e.id).trim().slice(0, 40);
  const slider = e.closest(".q-slider"), writes = e.tagName === "INPUT" && e.getAttribute("role") !== "combobox";
  const acts = e.matches("a, button, summary, input, [role]") || slider;
  const key = !acts ? "" : slider ? "ArrowRight" : writes ? "1" : e.matches("a, summary") ? "Enter" : "Space";
  return { ring, inside, name, key, n: Number(e.dataset.n ?? -1) };
}"""
NUMBERED = """(controls) => [...document.querySelectorAll(controls)]
  .filter((e) => e.checkVisibility({ visibilityProperty: true }) && !e.disabled && !e.classList.contains("disabled")
    && e.tabIndex >= 0 && e.getBoundingClientRect().width > 0)
  .map((e, n) => { e.dataset.n = n; return (e.getAttribute("aria-label") || e.textContent).trim().slice(0, 40); })"""
