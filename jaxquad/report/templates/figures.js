"use strict";
// Read-outs under the pointer, and figures as large as the window; texts never become markup.
for (const figure of document.querySelectorAll("figure[data-curves]")) {
  const panels = JSON.parse(figure.dataset.curves);
  const frame = figure.querySelector(".frame");
  const made = (name) => frame.appendChild(Object.assign(document.createElement("div"), {className: name}));
  const line = made("line"), note = made("note");
  line.hidden = note.hidden = true;

  const scaled = ([low, high, log], share) =>
    log ? low * Math.pow(high / low, share) : low + share * (high - low);
  const nearest = (values, x) => {
    let best = 0;
    for (let k = 1; k < values.length; k++) {
      if (Math.abs(values[k] - x) < Math.abs(values[best] - x)) best = k;
    }
    return best;
  };
  const place = ([low, high, log], x) =>
    log ? Math.log(x / low) / Math.log(high / low) : (x - low) / (high - low);

  const read = (event) => {
    const area = frame.getBoundingClientRect();
    const across = (event.clientX - area.left) / area.width;
    const down = (event.clientY - area.top) / area.height;
    const panel = panels.find(({box: [left, top, width, height]}) =>
      across >= left && across <= left + width && down >= top && down <= top + height);
    line.hidden = note.hidden = !panel;
    if (!panel) return;
    const [left, top, width, height] = panel.box;
    const x = scaled(panel.x, (across - left) / width);
    const first = panel.series[0][1], at = first[nearest(first, x)];
    const share = left + width * Math.min(1, Math.max(0, place(panel.x, at)));
    const rows = panel.series.map(([name, xs, ys]) => `${name || panel.up}: ${ys[nearest(xs, at)]}`);
    note.textContent = [`${panel.across || "x"}: ${at}`, ...rows].join("\n");
    line.style.left = `${100 * share}%`;
    line.style.top = `${100 * top}%`;
    line.style.height = `${100 * height}%`;
    const side = share > 0.5;
    note.style.left = side ? "auto" : `calc(${100 * share}% + 8px)`;
    note.style.right = side ? `calc(${100 * (1 - share)}% + 8px)` : "auto";
    note.style.top = `${100 * top}%`;
  };
  frame.addEventListener("pointermove", read);
  frame.addEventListener("pointerdown", read);
  frame.addEventListener("pointerleave", () => { line.hidden = note.hidden = true; });

  let size = 0; // 0: in the page; else a share of the window's width
  const image = frame.querySelector("img");
  const whole = () => innerWidth < 700 ? 1.8 : // a phone scrolls
    Math.min(1, Math.max(0.75, 0.9 * innerHeight * image.width / image.height / innerWidth));
  const zoom = (next) => {
    size = next < 0.7 * whole() ? 0 : Math.min(next, 6);
    button.textContent = size ? "Close" : "Enlarge";
    figure.classList.toggle("zoomed", size > 0);
    frame.style.width = size ? `${100 * size}%` : "";
  };
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Enlarge";
  button.addEventListener("click", () => zoom(size ? 0 : whole()));
  figure.append(button);
  figure.addEventListener("dblclick", () => zoom(size ? 0 : whole()));
  figure.addEventListener("wheel", (event) => {
    if (!size) return;
    event.preventDefault();
    zoom(Math.max(0.7 * whole(), size * (event.deltaY < 0 ? 1.2 : 1 / 1.2)));
  }, {passive: false});
  document.addEventListener("keydown", (event) => {
    if (!size) return;
    if (event.key === "Escape") zoom(0);
    if (event.key === "+") zoom(size * 1.2);
    if (event.key === "-") zoom(Math.max(0.7 * whole(), size / 1.2));
  });
}
