/** A list of questions, typed, pasted or dropped. */

import { useEffect, useId, useMemo, useState } from "preact/hooks";
import { asProblem } from "../api/client";
import { createBatch, listScenes } from "../api/service";
import type { BatchRequest, Problem } from "../api/types";
import { go, route } from "../route";
import { t } from "../text";
import { useLoaded } from "../ui/load";
import { ProblemNote } from "../ui/problem";
import { readQuestions } from "./questions";

export function NewBatch() {
  const { value: page, problem: unlisted } = useLoaded((signal) => listScenes(null, signal), []);
  const scenes = useMemo(() => page?.scenes.filter(({ status }) => status === "ready") ?? [], [page]);
  const [scene, setScene] = useState(route.peek().parameters.get("scene") ?? "");
  const [text, setText] = useState("");
  const [label, setLabel] = useState("");
  const [problem, setProblem] = useState<Problem | null>(null);
  const [over, setOver] = useState(false);
  const ids = { scene: useId(), questions: useId(), label: useId(), hint: useId() };

  useEffect(() => {
    if (!scene && scenes[0]) setScene(scenes[0].id);
  }, [scenes]);

  const items = useMemo(() => readQuestions(text), [text]);
  const readable = Array.isArray(items);

  const submit = async (event: Event) => {
    event.preventDefault();
    if (!readable || !items.length) return;
    try {
      // What is wrong with one question is told as that item's failure: nothing is checked here.
      const list = { items, defaults: { scene_id: scene }, label: label.trim() || null } as unknown as BatchRequest;
      const batch = await createBatch(list);
      go(["batches", batch.id]);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };

  const drop = async (event: DragEvent) => {
    event.preventDefault();
    setOver(false);
    const file = event.dataTransfer?.files[0];
    if (!file) return;
    setText(await file.text());
    setLabel((old) => old || file.name);
  };

  return (
    <form class="stack new-batch" onSubmit={(event) => void submit(event)} aria-label={t.batches.new}>
      {unlisted && <ProblemNote problem={unlisted} />}
      <div class="grid">
        <div class="field">
          <label for={ids.scene}>{t.batches.scene}</label>
          <select id={ids.scene} value={scene} onChange={(event) => setScene(event.currentTarget.value)}>
            {scenes.map(({ id, name, created_at }) => (
              <option key={id} value={id}>
                {name} ({t.date(created_at)})
              </option>
            ))}
          </select>
          {page && scenes.length === 0 && <span class="small">{t.batches.needsScene}</span>}
        </div>
        <div class="field">
          <label for={ids.label}>{t.batches.label}</label>
          <input id={ids.label} maxLength={200} value={label} onInput={(event) => setLabel(event.currentTarget.value)} />
        </div>
      </div>
      <div class="field">
        <label for={ids.questions}>{t.batches.questions}</label>
        <textarea
          id={ids.questions}
          rows={6}
          data-over={over}
          aria-describedby={ids.hint}
          value={text}
          onInput={(event) => setText(event.currentTarget.value)}
          onDragOver={(event) => {
            event.preventDefault();
            setOver(true);
          }}
          onDragLeave={() => setOver(false)}
          onDrop={(event) => void drop(event)}
        />
        <span id={ids.hint} class="small">
          {t.batches.hint}
        </span>
      </div>
      {!readable && <p class="bad">{t.batches.badLine(items.line)}</p>}
      {problem && <ProblemNote problem={problem} />}
      <div class="buttons">
        <button type="submit" class="main" disabled={!readable || items.length === 0 || !scene}>
          {t.batches.submit}
        </button>
        {readable && items.length > 0 && <span class="small">{t.batches.read(items.length)}</span>}
      </div>
    </form>
  );
}
