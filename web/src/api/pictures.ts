/** Pictures behind a key: fetched with it, shown from memory. An `<img>` by itself can send no header. */

import { request } from "./client";

interface Held { address: Promise<string>; users: number }

const held = new Map<string, Held>();

/** Pictures nobody shows any more are kept for a while: people go back and forth. */
const KEPT = 60;

export function borrowPicture(path: string): Promise<string> {
  let picture = held.get(path);
  if (!picture) {
    picture = { address: fetchPicture(path), users: 0 };
    picture.address.catch(() => held.delete(path));
  }
  picture.users += 1;
  // Last used, last in order.
  held.delete(path);
  held.set(path, picture);
  return picture.address;
}

export function returnPicture(path: string): void {
  const picture = held.get(path);
  if (!picture) return;
  picture.users -= 1;
  keepAtMost(KEPT);
}

/** What is drawn in pictures has changed: those that nobody shows are fetched anew. */
export const forgetPictures = () => keepAtMost(0);

function keepAtMost(most: number): void {
  for (const [old, { users, address }] of held) {
    if (held.size <= most) break;
    if (users > 0) continue;
    held.delete(old);
    void address.then((url) => URL.revokeObjectURL(url)).catch(() => undefined);
  }
}

async function fetchPicture(path: string): Promise<string> {
  return URL.createObjectURL(await (await request(path)).blob());
}

/** Saves what lies at a path as a file of the reader's. */
export async function download(path: string, name: string): Promise<void> {
  const address = await fetchPicture(path);
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
