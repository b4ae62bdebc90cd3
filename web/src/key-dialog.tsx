/** Where a key is entered. Afterwards the page loads anew: everything it asked without the key is asked again. */

import { useId, useState } from "preact/hooks";
import { currentKey, forgetKey, keepKey, keyWanted } from "./api/key";
import { t } from "./text";
import { Dialog } from "./ui/dialog";

export function KeyDialog({ onClose }: { onClose: () => void }) {
  const [key, setKey] = useState("");
  const field = useId();
  const hint = useId();
  const use = (event: Event) => {
    event.preventDefault();
    if (!key.trim()) return;
    keepKey(key);
    location.reload();
  };
  const forget = () => {
    forgetKey();
    location.reload();
  };
  return (
    <Dialog title={keyWanted.value === null ? t.key.button : t.key.title} onClose={onClose}>
      <form onSubmit={use} class="stack">
        {keyWanted.value && <p class="bad">{keyWanted.value}</p>}
        {currentKey() !== null && <p>{t.key.given}</p>}
        <div class="field">
          <label for={field}>{t.key.label}</label>
          <input
            id={field}
            type="password"
            autocomplete="off"
            aria-describedby={hint}
            value={key}
            onInput={(event) => setKey(event.currentTarget.value)}
          />
          <span id={hint} class="small">
            {t.key.hint}
          </span>
        </div>
        <div class="buttons">
          <button type="submit" class="main">
            {t.key.use}
          </button>
          {currentKey() !== null && (
            <button type="button" onClick={forget}>
              {t.key.forget}
            </button>
          )}
        </div>
      </form>
    </Dialog>
  );
}
