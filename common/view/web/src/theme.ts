// Dark, light or high contrast: as the system has it, until a person chooses.

export type Theme = "dark" | "light" | "contrast";

const KEPT = "slag-theme";
const THEMES: Theme[] = ["dark", "light", "contrast"];
const queries = { contrast: matchMedia("(prefers-contrast: more)"), light: matchMedia("(prefers-color-scheme: light)") };

export function themeNow(): Theme {
  const kept = localStorage.getItem(KEPT) as Theme | null;
  if (kept && THEMES.includes(kept)) return kept;
  return queries.contrast.matches ? "contrast" : queries.light.matches ? "light" : "dark";
}

/** Applies the theme now and whenever it changes. */
export function followTheme(onTheme: (theme: Theme) => void): void {
  const apply = () => {
    document.documentElement.dataset.theme = themeNow();
    onTheme(themeNow());
  };
  for (const query of Object.values(queries)) query.addEventListener("change", apply);
  addEventListener("slag-theme", apply);
  apply();
}

export function nextTheme(): void {
  localStorage.setItem(KEPT, THEMES[(THEMES.indexOf(themeNow()) + 1) % THEMES.length]);
  dispatchEvent(new Event("slag-theme"));
}
