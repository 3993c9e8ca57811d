// A plot whose colours follow the theme, whose points light up in all plots beside it, and which moves from one state
// to the next. Data come as plain numbers; texts are text: Plotly's own markup is taken out of them.
const charts = new Set();
const dark = () => document.body.classList.contains("body--dark");
let turn = Promise.resolve();
const shown = () => new Promise((done) => setTimeout(done));
// Numbers of the readings that are marked in every plot of the page; how often others were; and whether that is changing.
let marked = null, marks = 0, marking = false;
// How far each key leads along the readings of a plot; a page is a twentieth of them.
const STEPS = { " ": 0, ArrowRight: 1, ArrowLeft: -1, Home: -Infinity, End: Infinity };
const PAGES = { PageDown: 1, PageUp: -1 };
const calm = () => window.matchMedia("(prefers-reduced-motion: reduce)").matches;

function colours(value, style) {
  if (typeof value === "string") return value[0] === "@" ? style.getPropertyValue("--" + value.slice(1)).trim() : value;
  if (Array.isArray(value)) return typeof value[0] === "number" ? value : value.map((v) => colours(v, style));
  if (value && typeof value === "object")
    return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, colours(v, style)]));
  return value;
}

function inLines(text, letters) {
  const lines = [""];
  for (const word of text.split(" ")) {
    if (lines.at(-1) && (lines.at(-1) + " " + word).length > letters) lines.push(word);
    else lines.push((lines.pop() + " " + word).trim());
  }
  return lines.join("<br>");
}

export default {
  template: `<div class="chart" role="img"></div>`,
  // `view`: what the user changed of its layout on an earlier visit; `brushed`: readings that were marked then.
  props: { options: Object, view: Object, brushed: Array },
  created() {
    this.drawn = new Promise((done) => { this.begin = done; });
  },
  async mounted() {
    const { Plotly } = await import("nicegui-plotly");
    this.Plotly = Plotly;
    if (!charts.size) marked = this.brushed?.length ? new Set(this.brushed) : null; // another page, or other readings
    // One after the other, each shown before the next is drawn.
    await (turn = turn.then(() => this.$el.isConnected && this.begun()).then(shown, shown));
    if (!this.$el.isConnected) return;
    charts.add(this);
    this.listen();
    // It is told the size at once, in which the plot is drawn already.
    this.resized = new ResizeObserver(() => {
      const { clientWidth, clientHeight, _fullLayout: now } = this.$el;
      if (clientWidth !== now.width || clientHeight !== now.height) this.Plotly.Plots.resize(this.$el);
    });
    this.resized.observe(this.$el);
    // Keys and pointers change the body's classes too.
    let theme = dark();
    this.themed = new MutationObserver(() => { if (theme !== (theme = dark())) this.draw(); });
    this.themed.observe(document.body, { attributes: true, attributeFilter: ["class"] });
    this.$el.dataset.drawn = "yes";
    this.begin();
  },
  unmounted() {
    charts.delete(this);
    this.resized?.disconnect();
    this.themed?.disconnect();
    if (this.Plotly) this.Plotly.purge(this.$el);
  },
  watch: {
    options() { this.moved = null; if (this.Plotly) this.draw(); },
  },
  methods: {
    styled() {
      const { data, layout } = colours(this.moved ?? this.options, getComputedStyle(document.body));
      for (const trace of data) if (trace.ids && marked !== null) trace.selectedpoints = this.lit(trace);
      // A title that is longer than its axis is on several lines.
      const letters = Math.max((this.$el.clientWidth - 110) / 8, 16);
      for (const [name, axis] of Object.entries(layout))
        if (/^xaxis/.test(name) && axis.title?.text?.length > letters)
          axis.title = { ...axis.title, text: inLines(axis.title.text, letters) };
      // Plotly writes the part in sight into the ranges that it is given.
      for (const axis of [layout.xaxis, layout.yaxis]) if (axis?.range) axis.range = [...axis.range];
      // Without the box that was drawn: Plotly would select by it again, in its own plot only.
      Object.assign(layout, { selections: [], selectionrevision: marks });
      // As many dots as the screen has; Plotly's own are twice as fine each way, and cost four times as much to draw.
      return { data, layout, config: { displaylogo: false, responsive: false, scrollZoom: false,
        plotGlPixelRatio: Math.max(window.devicePixelRatio, 1),
        modeBarButtonsToRemove: ["toImage", "autoScale2d"] } };
    },
    draw() {
      const { data, layout, config } = this.styled();
      this.forget();
      return this.Plotly.react(this.$el, data, layout, config);
    },
    async begun() {
      await this.draw();
      // As if the user did it now, so that a double click leads back to the whole plot.
      if (this.view) await this.Plotly.relayout(this.$el, this.view);
    },
    listen() {
      const ids = (event) => (event?.points ?? []).map((p) => p.data.ids ? Number(p.data.ids[p.pointIndex]) : NaN)
        .filter((id) => !Number.isNaN(id));
      this.$el.on("plotly_selected", (event) => {
        if (event) this.mark(ids(event));
      });
      this.$el.on("plotly_deselect", () => {
        if (marked !== null) this.mark(null);
      });
      this.$el.on("plotly_hover", (event) => {
        const found = ids(event);
        if (found.length && found[0] !== this.hovered) this.$emit("reading", (this.hovered = found[0]));
      });
      this.$el.on("plotly_click", (event) => { const found = ids(event); if (found.length) this.$emit("reading", found[0]); });
      this.$el.on("plotly_relayout", (event) => {
        const now = this.$el._fullLayout, changed = Object.keys(event).join();
        this.forget();
        if (/^scene\.camera/.test(changed)) {
          const own = this.$el.layout.scene.camera ?? {}, plain = now.scene.camera; // Plotly's own where it was reset
          this.$emit("camera", ["eye", "center", "up"].map((k) => own[k] ?? plain[k]).map(({ x, y, z }) => [x, y, z]));
        }
        if (!/(^|,)[xy]axis2?\.(auto)?range/.test(changed)) return;
        const whole = (name) => this.options.layout[name]?.range?.join() === now[name].range.join();
        const cut = ["xaxis", "yaxis", "yaxis2"].filter((name) => now[name] && !now[name].autorange && !whole(name));
        this.$emit("zoom", Object.fromEntries(cut.map((name) => [name.replace("axis", ""), now[name].range])));
      });
      this.$el.addEventListener("keydown", (event) => {
        const far = STEPS[event.key] ?? PAGES[event.key];
        if (far === undefined || event.target !== this.$el || event.ctrlKey || event.altKey || event.metaKey) return;
        event.preventDefault();
        this.walk(far, event.key in PAGES);
      });
      this.$el.addEventListener("blur", () => this.ring?.remove());
    },
    // Other readings are seen, or at other places.
    forget() { this.order = null; this.ring?.remove(); },
    // The readings that are seen, from left to right, or around the circle.
    readings() {
      const { xaxis, yaxis } = this.$el._fullLayout, seen = (v, axis) => (v - axis.range[0]) * (v - axis.range[1]) <= 0;
      const all = this.$el.data.flatMap((trace) => (trace.ids ?? []).map((id, k) => (
        { across: (trace.x ?? trace.theta)[k], up: (trace.y ?? trace.r)[k], id: Number(id), polar: !trace.x })));
      return all.filter((p) => p.polar || (seen(p.across, xaxis) && seen(p.up, yaxis)))
        .sort((p, q) => p.across - q.across || p.up - q.up || p.id - q.id);
    },
    // Says the reading so many further on, as if it were pointed at, and rings it.
    walk(far, pages) {
      this.order ??= this.readings();
      const last = this.order.length - 1, at = this.order.findIndex((p) => p.id === this.hovered);
      if (last < 0) return;
      const by = pages ? far * Math.ceil(last / 20) : far;
      const { id, across, up, polar } = this.order[Math.min(Math.max(at + by, 0), last)];
      this.$emit("reading", (this.hovered = id));
      this.ring?.remove();
      if (polar) return;
      const { xaxis, yaxis } = this.$el._fullLayout;
      this.ring = this.$el.appendChild(document.createElement("div"));
      this.ring.className = "ring";
      this.ring.style.left = `${xaxis._offset + xaxis.l2p(across)}px`;
      this.ring.style.top = `${yaxis._offset + yaxis.l2p(up)}px`;
    },
    lit(trace) {
      return trace.ids.reduce((points, id, i) => { if (marked.has(Number(id))) points.push(i); return points; }, []);
    },
    async mark(found) {
      if (marking) return;
      marking = true;
      this.$emit("brush", found ?? []);
      marked = found && new Set(found);
      marks += 1;
      await Promise.all([...charts].filter((c) => c.holds(found ?? [])).map((c) => c.draw()));
      marking = false;
    },
    // Whether it has all of these readings. Into a plot of single readings that has not, the server puts them.
    holds(found) {
      const own = new Set(this.options.data.flatMap((trace) => trace.ids ?? []));
      return own.size > 0 && found.every((id) => own.has(String(id)));
    },
    // Moves every trace of the same length from where it is to where it will be, and leaves the rest as it is.
    async morph(options, ms) {
      await this.drawn; // a slow PC draws the plots before it first
      this.$el.dataset.moved = "no";
      this.moved = options; // what a change of the theme draws
      const target = this.styled(); // its layout is not drawn
      const from = this.$el.data.map((t) => Array.from(t.y ?? []));
      const moving = target.data.map((t, k) => k).filter((k) => from[k]?.length && from[k].length === target.data[k].y.length);
      const end = () => { this.$el.dataset.moved = "yes"; };
      if (calm() || !moving.length) return this.Plotly.react(this.$el, target.data, this.$el.layout).then(end);
      const began = performance.now();
      const step = (now) => {
        if (!this.$el.isConnected) return;
        const share = Math.min((now - began) / ms, 1), eased = share * share * (3 - 2 * share);
        const y = moving.map((k) => from[k].map((v, i) => v + eased * (target.data[k].y[i] - v)));
        this.Plotly.restyle(this.$el, { y }, moving);
        if (share < 1) requestAnimationFrame(step);
        else end();
      };
      requestAnimationFrame(step);
    },
    append(x, y, most) {
      this.options.data.forEach((trace, k) => {
        trace.x = [...trace.x, ...x[k]].slice(-most);
        trace.y = [...trace.y, ...y[k]].slice(-most);
      });
      if (!this.Plotly || !this.$el.data) return;
      this.Plotly.extendTraces(this.$el, { x, y }, x.map((_, k) => k), most);
    },
  },
};
