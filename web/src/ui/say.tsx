/** Tells readers of screens, and shows for a moment, what happened elsewhere than where they look. */

import { signal } from "@preact/signals";

const said = signal("");
let fading = 0;

export function say(words: string): void {
  // The same words twice are news again.
  said.value = said.value === words ? `${words}\u00a0` : words;
  clearTimeout(fading);
  fading = window.setTimeout(() => (said.value = ""), 5000);
}

export function Said() {
  return (
    <div class="said" role="status" aria-live="polite" data-shown={said.value !== ""}>
      {said.value}
    </div>
  );
}
