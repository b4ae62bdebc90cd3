/** Where people say what is wrong with a parse: of one thing, of several at once; and what was said so far. */

import { useState } from "preact/hooks";
import { asProblem } from "../api/client";
import { download } from "../api/pictures";
import { annotationsPath } from "../api/service";
import type { Change, Correction, InstanceView } from "../api/types";
import { t } from "../text";
import { ProblemNote } from "../ui/problem";
import { foundAs, nameOf } from "./names";
import type { Room } from "./state";

/** Longest name the service takes. */
export const NAME_LENGTH = 100;

/** What can be said of one thing. */
export function Wrong({ room, thing }: { room: Room; thing: InstanceView }) {
  const { busy } = room.corrections;
  const gathered = room.group.value.includes(thing.id);
  const say = (change: Change) => void room.correct(change);
  if (thing.dismissed) return <p class="warn">{t.corrections.isJunk}</p>;
  return (
    <fieldset>
      <legend>{t.corrections.wrong}</legend>
      <div class="buttons">
        <button type="button" disabled={busy.value} onClick={() => say({ kind: "dismiss", instance_ids: [thing.id] })}>
          {t.corrections.junk}
        </button>
        {thing.level === "thing" && (
          <>
            <button type="button" disabled={busy.value} onClick={() => say({ kind: "split", instance_id: thing.id })}>
              {t.corrections.notOne}
            </button>
            <button type="button" aria-pressed={gathered} onClick={() => room.gather(thing.id)}>
              {gathered ? t.corrections.letGo : t.corrections.gather}
            </button>
          </>
        )}
      </div>
    </fieldset>
  );
}

/** What can be said of several things. */
export function Gathered({ room }: { room: Room }) {
  const ids = room.group.value;
  const { busy } = room.corrections;
  if (ids.length === 0) return null;
  return (
    <section class="gathered" aria-label={t.corrections.gathered}>
      <p role="status">
        <b>{t.corrections.chosen(ids.length)}</b> {ids.length === 1 && <span class="small">{t.corrections.more}</span>}
      </p>
      <ul class="chips">
        {ids.map((id) => (
          <li key={id}>
            <button type="button" class="chip" aria-label={t.corrections.drop(called(room, id))} onClick={() => room.gather(id)}>
              {called(room, id)} <span aria-hidden="true">×</span>
            </button>
          </li>
        ))}
      </ul>
      <div class="buttons">
        <button
          type="button"
          class="main"
          disabled={busy.value || ids.length < 2}
          onClick={() => void room.correct({ kind: "merge", instance_ids: ids })}
        >
          {t.corrections.one}
        </button>
        <button type="button" disabled={busy.value} onClick={() => void room.correct({ kind: "dismiss", instance_ids: ids })}>
          {t.corrections.allJunk}
        </button>
        <button type="button" class="quiet" onClick={() => (room.group.value = [])}>
          {t.cancel}
        </button>
      </div>
    </section>
  );
}

export function CorrectionsSoFar({ room }: { room: Room }) {
  const { all, problem } = room.corrections;
  const [failed, setFailed] = useState(problem.value);
  const holding = all.value.filter(({ undone_at }) => !undone_at).length;
  const save = () => void download(annotationsPath(room.id), "annotations.json").catch((thrown) => setFailed(asProblem(thrown)));
  return (
    <>
      {(problem.value ?? failed) && <ProblemNote problem={(problem.value ?? failed)!} />}
      <details class="corrections">
        <summary>
          {t.corrections.title} ({holding})
        </summary>
        <p class="small">{t.corrections.hint}</p>
        <ul class="lines">
          {all.value.map((correction) => (
            <Entry key={correction.id} room={room} correction={correction} />
          ))}
        </ul>
        <div class="buttons">
          <button type="button" onClick={save}>
            {t.corrections.download}
          </button>
          <span class="small">{t.corrections.downloadHint}</span>
        </div>
      </details>
    </>
  );
}

function Entry({ room, correction: { id, change, made, author, created_at, undone_at } }: { room: Room; correction: Correction }) {
  const words = wordsOf(room, change, made);
  return (
    <li class="correction" data-undone={undone_at != null}>
      <span>
        {undone_at ? <s>{words}</s> : words}
        <span class="small">
          {author ?? t.corrections.nobody} · <time dateTime={created_at}>{t.date(created_at)}</time>
          {undone_at && ` · ${t.corrections.takenBack(t.date(undone_at))}`}
        </span>
      </span>
      {!undone_at && (
        <button
          type="button"
          class="quiet"
          disabled={room.corrections.busy.value}
          aria-label={t.corrections.undoThis(words)}
          onClick={() => void room.corrections.undo(id)}
        >
          {t.corrections.undo}
        </button>
      )}
    </li>
  );
}

function wordsOf(room: Room, change: Change, made: number | null | undefined): string {
  switch (change.kind) {
    case "rename":
      return t.corrections.said.rename(cutAs(room, change.instance_id), change.name);
    case "dismiss":
      return t.corrections.said.dismiss(change.instance_ids.map((id) => cutAs(room, id)));
    case "merge":
      return t.corrections.said.merge(change.instance_ids.map((id) => cutAs(room, id)), made ?? null);
    case "split":
      return t.corrections.said.split(cutAs(room, change.instance_id));
  }
}

/** As it is called now. */
function called(room: Room, id: number): string {
  const thing = room.instances.value.get(id);
  return t.things.onThing(thing ? nameOf(thing) : "", id);
}

/** As the parse called it: what people call it is what corrections say. */
function cutAs(room: Room, id: number): string {
  const thing = room.instances.value.get(id);
  return t.things.onThing(thing ? foundAs(thing) : "", id);
}
