import { useEffect, useRef } from "preact/hooks";
import { t } from "../text";

/** A name being changed: Enter keeps it, Escape does not. */
export function RenameForm({ name, onDone }: { name: string; onDone: (name: string) => void }) {
  const field = useRef<HTMLInputElement>(null);
  useEffect(() => field.current!.select(), []);
  const keep = (event: Event) => {
    event.preventDefault();
    onDone(field.current!.value.trim());
  };
  return (
    <form class="rename" onSubmit={keep} onKeyDown={(event) => event.key === "Escape" && onDone("")}>
      <input ref={field} aria-label={t.scenes.newName} maxLength={200} defaultValue={name} />
      <button type="submit">{t.save}</button>
      <button type="button" class="quiet" onClick={() => onDone("")}>
        {t.cancel}
      </button>
    </form>
  );
}
