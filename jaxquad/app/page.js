// The page goes to what is new, takes a file that is dropped anywhere, and names sliders.
if (!window.jaxquad) {
  const jaxquad = (window.jaxquad = { moved: false });
  for (const kind of ["wheel", "touchmove", "pointerdown", "keydown"])
    addEventListener(kind, () => (jaxquad.moved = true), { capture: true, passive: true });

  // To a heading, with the focus, unless the pilot has moved elsewhere while it was computed.
  jaxquad.go = (id, tries = 40) => {
    const heading = document.getElementById(id);
    if (!heading && tries) setTimeout(() => jaxquad.go(id, tries - 1), 50);
    if (!heading || jaxquad.moved) return;
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    heading.focus({ preventScroll: true });
    const scroll = () =>
      document.activeElement === heading && !jaxquad.moved &&
      heading.scrollIntoView({ behavior: still ? "instant" : "smooth", block: "start" });
    for (const wait of [0, 500, 1500]) setTimeout(scroll, wait); // below it figures still grow
  };

  // Files: to the box below the pointer, else to the nearest one of the tab that is shown.
  const far = (box, x, y) => {
    const place = box.getBoundingClientRect();
    return Math.hypot(x - (place.left + place.right) / 2, y - (place.top + place.bottom) / 2);
  };
  const nearest = (event) =>
    [...document.querySelectorAll(".upload")].sort(
      (a, b) => far(a, event.clientX, event.clientY) - far(b, event.clientX, event.clientY),
    )[0];
  const dragged = (inside) => document.documentElement.classList.toggle("dragged", inside);
  addEventListener("dragover", (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return;
    event.preventDefault();
    dragged(true);
    event.dataTransfer.dropEffect = nearest(event) ? "copy" : "none";
  });
  addEventListener("dragleave", (event) => event.relatedTarget || dragged(false));
  addEventListener("drop", () => dragged(false), { capture: true });
  addEventListener("drop", (event) => {
    if (!event.dataTransfer?.files.length || event.defaultPrevented) return;
    event.preventDefault();
    const input = nearest(event)?.querySelector("input[type=file]");
    if (!input) return;
    input.files = event.dataTransfer.files;
    input.dispatchEvent(new Event("change", { bubbles: true }));
  });

  // Quasar gives role, name and value to the slider's frame, and the focus to what is inside.
  const give = (element, attributes) => {
    for (const [name, value] of Object.entries(attributes))
      if (element.getAttribute(name) !== value) element.setAttribute(name, value);
  };
  const names = () => {
    for (const frame of document.querySelectorAll(".q-slider")) {
      const of = (name) => frame.getAttribute(`aria-${name}`);
      const [ends, range] = [of("valuenow").split("|"), frame.matches(".q-range")];
      frame.querySelectorAll(range ? ".q-slider__thumb" : "[tabindex]").forEach((handle, k) =>
        give(handle, {
          role: "slider", "aria-label": range ? `${["start", "end"][k]} of the range, s` : of("label"),
          "aria-valuemin": of("valuemin"), "aria-valuemax": of("valuemax"), "aria-valuenow": ends[k],
        }));
      give(frame, { role: "group" });
      if (range) // the arrow keys move both ends
        give(frame.firstElementChild, { role: "group", "aria-label": "both ends of the range" });
    }
  };
  new MutationObserver(names).observe(document.body, {
    childList: true,
    subtree: true,
    attributeFilter: ["aria-valuenow"],
  });
  names();
}
