/** A question, how it is to be answered, and what was asked before. */

import { useEffect, useId, useMemo, useState } from "preact/hooks";
import { listAnswers } from "../api/service";
import type { Answer } from "../api/types";
import { t } from "../text";
import { ProblemNote } from "../ui/problem";
import { AnswerCard } from "./answer";
import { examplesFor } from "./examples";
import { QuestionOptions } from "./options";
import type { Room } from "./state";

const REMEMBERED = 50;

export function AskPanel({ room }: { room: Room }) {
  const field = useId();
  const examples = useMemo(() => examplesFor(room.instances.value.values()), [room.instances.value]);
  const ask = (event?: Event) => {
    event?.preventDefault();
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
    <>
      <form class="ask" onSubmit={ask}>
        <label for={field}>{t.ask.label}</label>
        <div class="ask-line">
          <textarea
            id={field}
            rows={2}
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
        {!room.answer.value && examples.length > 0 && (
          <div class="examples">
            <span class="small">{t.ask.examples}</span>
            {examples.map((example) => (
              <button type="button" key={example} class="chip" onClick={() => askThis(example)}>
                {example}
              </button>
            ))}
          </div>
        )}
        <QuestionOptions room={room} />
      </form>
      {room.askProblem.value && <ProblemNote problem={room.askProblem.value} />}
      <div aria-live="polite">{room.answer.value && <AnswerCard room={room} answer={room.answer.value} />}</div>
      <History room={room} />
    </>
  );
}

/** A question that was asked several times stands there once, with its latest answer. */
const latestOf = (answer: Answer, i: number, all: Answer[]) => all.findIndex(({ query }) => query === answer.query) === i;

function History({ room }: { room: Room }) {
  const [answers, setAnswers] = useState<Answer[]>([]);
  const shown = room.answer.value?.id;
  useEffect(() => {
    let current = true;
    listAnswers(room.id, REMEMBERED).then(
      (page) => current && setAnswers(page.answers.filter(latestOf)),
      () => undefined,
    );
    return () => {
      current = false;
    };
  }, [shown]);
  return (
    <section class="history">
      <h3>{t.ask.history}</h3>
      {answers.length === 0 && <p class="small">{t.ask.noHistory}</p>}
      <ul class="lines">
        {answers.map((answer) => (
          <li key={answer.id}>
            <button type="button" class="line" aria-current={answer.id === shown ? "true" : undefined} onClick={() => void room.open(answer.id)}>
              <span>{answer.query}</span>
              <span class={`badge ${answer.status}`}>{t.answer.status[answer.status]}</span>
            </button>
          </li>
        ))}
      </ul>
    </section>
  );
}
