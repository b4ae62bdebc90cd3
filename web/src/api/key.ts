/** The caller's key: entered once, kept for this tab only, shown to no origin but the page's own. */

import { signal } from "@preact/signals";

const PLACE = "uniground.key";

/** Why a key is asked for: set when the service refused one, or none. */
export const keyWanted = signal<string | null>(null);

/** Whether this server has refused a request for want of a key. */
export const serverHasKeys = signal(false);

export function currentKey(): string | null {
  return sessionStorage.getItem(PLACE);
}

export function keepKey(key: string): void {
  sessionStorage.setItem(PLACE, key.trim());
}

export function forgetKey(): void {
  sessionStorage.removeItem(PLACE);
}

/**
 * The address a path of the service means. The page may be below a prefix of a proxy, and so are all paths. Refused where it is not this
 * origin's: a link in an answer must not carry the key away.
 */
export function ownAddress(path: string): string {
  const page = new URL(".", location.href);
  const address = new URL(path.replace(/^\/+/, ""), page);
  if (address.origin !== location.origin) throw new TypeError(`not of this server: ${path}`);
  return address.href;
}

export function keyHeaders(): Record<string, string> {
  const key = currentKey();
  return key ? { authorization: `Bearer ${key}` } : {};
}
