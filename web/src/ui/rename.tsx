import { useEffect, useRef } from "preact/hooks";
import { t } from "../text";

interface Properties { name: string; label: string; maxLength: number; onDone: (name: string) => void }

/** A name being changed: Enter keeps it, Escape does not, and then it is told as empty. */
export function RenameForm({ name, label, maxLength, onDone }: Properties) {
  const field = useRef<HTMLInputElement>(null);
  useEffect(() => field.current!.select(), []);
  const keep = (event: Event) => {
    event.preventDefault();
    onDone(field.current!.value.trim());
  };
  return (
    <form class="rename" onSubmit={keep} onKeyDown={(event) => event.key === "Escape" && onDone("")}>
      <input ref={field} aria-label={label} maxLength={maxLength} defaultValue={name} />
      <button type="submit">{t.save}</button>
      <button type="button" class="quiet" onClick={() => onDone("")}>
        {t.cancel}
      </button>
    </form>
  );
}
