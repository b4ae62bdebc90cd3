/** Whether the window is too narrow for a room and its panels side by side: as in style/room.css. */

import { signal } from "@preact/signals";

const query = matchMedia("(max-width: 860px)");

export const narrow = signal(query.matches);

query.addEventListener("change", () => (narrow.value = query.matches));
