/** The question box, the latest answer, and earlier questions. */

import { useId, useMemo } from "preact/hooks";
import { t } from "../text";
import { ModelsNote } from "../ui/models";
import { narrow } from "../ui/narrow";
import { ProblemNote } from "../ui/problem";
import { AnswerCard } from "./answer";
import { examplesFor } from "./examples";
import { History } from "./history";
import { QuestionOptions } from "./options";
import type { Room } from "./state";

/** The question box. In narrow windows it is above the room, otherwise in the panel. */
export function AskForm({ room, examples }: { room: Room; examples?: string[] }) {
  const field = useId();
  const made = useMemo(() => examplesFor(room.instances.value.values()), [room.instances.value]);
  const offered = examples ?? made;
  const ask = (event?: Event) => {
    event?.preventDefault();
    // The keyboard on the screen would cover the answer.
    if (narrow.peek()) (document.activeElement as HTMLElement | null)?.blur();
    void room.ask();
  };
  const askThis = (query: string) => {
    room.question.value = query;
    ask();
  };
  const enter = (event: KeyboardEvent) => {
    if (event.key === "Enter" && !event.shiftKey) ask(event);
  };
  return (
    <form class="ask" onSubmit={ask}>
      <label for={field}>{t.ask.label}</label>
      <div class="ask-line">
        <textarea
          id={field}
          rows={narrow.value ? 1 : 2}
          maxLength={2000}
          placeholder={t.ask.placeholder}
          value={room.question.value}
          onInput={(event) => (room.question.value = event.currentTarget.value)}
          onKeyDown={enter}
        />
        <button type="submit" class="main" disabled={room.asking.value}>
          {room.asking.value ? t.ask.asking : t.ask.submit}
        </button>
      </div>
      {!room.answer.value && offered.length > 0 && (
        <div class="examples">
          <span class="small">{t.ask.examples}</span>
          {offered.map((example) => (
            <button type="button" key={example} class="chip" onClick={() => askThis(example)}>
              {example}
            </button>
          ))}
        </div>
      )}
    </form>
  );
}

export function AskPanel({ room }: { room: Room }) {
  const models = room.models.value;
  return (
    <>
      {!narrow.value && <AskForm room={room} />}
      <QuestionOptions room={room} />
      {room.askProblem.value && <ProblemNote problem={room.askProblem.value} />}
      <div aria-live="polite">{room.answer.value && <AnswerCard room={room} answer={room.answer.value} />}</div>
      {models && <ModelsNote models={models} parsed={room.scene.value?.models} />}
      <History room={room} />
    </>
  );
}
