/** Light or dark: as the system has it, unless the reader chose. */

import { effect, signal } from "@preact/signals";

export type Theme = "auto" | "light" | "dark";

const PLACE = "uniground.theme";
const system = matchMedia("(prefers-color-scheme: dark)");
const systemIsDark = signal(system.matches);
system.addEventListener("change", () => (systemIsDark.value = system.matches));

function stored(): Theme {
  const theme = localStorage.getItem(PLACE);
  return theme === "light" || theme === "dark" ? theme : "auto";
}

export const theme = signal<Theme>(stored());

export const isDark = () => (theme.value === "auto" ? systemIsDark.value : theme.value === "dark");

effect(() => {
  document.documentElement.dataset.theme = isDark() ? "dark" : "light";
  if (theme.value === "auto") localStorage.removeItem(PLACE);
  else localStorage.setItem(PLACE, theme.value);
});
