import { t } from "../text";
import { say } from "./say";

/** Copies, and says so. Without HTTPS browsers offer no clipboard: then by the old way. */
export async function copy(text: string, done = t.copied): Promise<void> {
  try {
    if (navigator.clipboard) await navigator.clipboard.writeText(text);
    else copyByHand(text);
    say(done);
  } catch {
    say(t.notCopied);
  }
}

function copyByHand(text: string): void {
  const field = document.createElement("textarea");
  field.value = text;
  field.className = "offscreen";
  document.body.append(field);
  field.select();
  const copied = document.execCommand("copy");
  field.remove();
  if (!copied) throw new Error("refused");
}
