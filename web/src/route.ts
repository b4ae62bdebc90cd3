/**
 * Where the page is, in the part of the address after `#`: `#/scenes/ID?tab=ask&answer=ID&cam=…`.
 *
 * A link opens the same scene, question and view again. What stands after `#` is never sent to a server, so questions and
 * views are in nobody's log.
 */

import { signal } from "@preact/signals";

export interface Route {
  path: string[];
  parameters: URLSearchParams;
}

function read(): Route {
  const [path = "", query = ""] = location.hash.replace(/^#\/?/, "").split("?");
  return { path: path.split("/").filter(Boolean).map(decodeURIComponent), parameters: new URLSearchParams(query) };
}

export const route = signal<Route>(read());

addEventListener("hashchange", () => (route.value = read()));

export function address(path: string[], parameters: Record<string, string> = {}): string {
  const query = new URLSearchParams(parameters).toString();
  return `#/${path.map(encodeURIComponent).join("/")}${query && `?${query}`}`;
}

export function go(path: string[], parameters: Record<string, string> = {}): void {
  location.hash = address(path, parameters);
}

/**
 * Changes parameters of this place, without a step in the browser's history unless one is wanted.
 *
 * The address changes before `hashchange` arrives. What the place that is being left wants to note in between is dropped:
 * it would lead back there.
 */
export function amend(changes: Record<string, string | null>, step = false): void {
  const { path, parameters } = route.peek();
  if (address(read().path) !== address(path)) return;
  const changed = new URLSearchParams(parameters);
  for (const [name, value] of Object.entries(changes)) {
    if (value === null) changed.delete(name);
    else changed.set(name, value);
  }
  const hash = address(path, Object.fromEntries(changed));
  if (hash === location.hash) return;
  if (step) history.pushState(null, "", hash);
  else history.replaceState(null, "", hash);
  route.value = read();
}
