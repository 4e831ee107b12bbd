/** What a person has chosen for this browser. Kept in localStorage where there is one, else for this page only. */

const NAME = "prefrl.settings";

const DEFAULTS = {
  theme: "auto",
  keys: true,
  bindings: {},
  autoplay: true,
  speed: 1,
  stacked: false,
  linked: true,
  written: false,
  diff: false,
  invisible: false,
  length: false,
  size: "medium",
  guideline: "",
};

const listeners = new Set();
let values = { ...DEFAULTS, ...load() };

function load() {
  try {
    const kept = JSON.parse(localStorage.getItem(NAME) ?? "{}");
    return typeof kept === "object" && kept !== null ? kept : {};
  } catch {
    return {};
  }
}

function keep() {
  try {
    localStorage.setItem(NAME, JSON.stringify(values));
  } catch {
    // A full or forbidden storage costs only the memory of these choices.
  }
}

export const settings = {
  get: (name) => values[name],
  set(name, value) {
    values = { ...values, [name]: value };
    keep();
    dress();
    listeners.forEach((listener) => listener(name));
  },
  /** Call `listener(name)` at each change; the result stops it. */
  watch(listener) {
    listeners.add(listener);
    return () => listeners.delete(listener);
  },
};

/** Show the chosen colours, text size and arrangement. */
export function dress() {
  const root = document.documentElement;
  root.dataset.theme = values.theme;
  root.dataset.size = values.size;
  root.classList.toggle("text-stacked", values.stacked);
}

addEventListener("storage", (event) => {
  if (event.key !== NAME) return;
  values = { ...DEFAULTS, ...load() };
  dress();
  listeners.forEach((listener) => listener(""));
});
