// Light or dark colours, before the first picture: those of the system, until the user chooses.
"use strict";

globalThis.theme = (() => {
  const KEY = "theme", system = matchMedia("(prefers-color-scheme: dark)");
  const name = (dark) => (dark ? "dark" : "light");

  // A browser may refuse storage.
  function stored() {
    try {
      return localStorage.getItem(KEY);
    } catch {
      return null;
    }
  }

  function store(value) {
    try {
      if (value === name(system.matches)) localStorage.removeItem(KEY);
      else localStorage.setItem(KEY, value);
    } catch {
      // The choice holds until the page is closed.
    }
  }

  function show(value) {
    document.documentElement.dataset.theme = value;
    document.dispatchEvent(new Event("theme"));
  }

  system.addEventListener("change", () => show(stored() ?? name(system.matches)));
  show(stored() ?? name(system.matches));
  return {
    get dark() {
      return document.documentElement.dataset.theme === "dark";
    },
    toggle() {
      const next = name(!this.dark);
      store(next);
      show(next);
    },
  };
})();
