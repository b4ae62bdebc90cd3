/** All scenes, newest first, and the place to drop a new scan. */

import { useCallback, useEffect, useState } from "preact/hooks";
import { asProblem } from "../api/client";
import { getModels, listScenes } from "../api/service";
import type { Problem, Scene } from "../api/types";
import { t } from "../text";
import { useLoaded } from "../ui/load";
import { ModelsNote } from "../ui/models";
import { ProblemNote } from "../ui/problem";
import { SceneCard } from "./card";
import { type Upload, UploadPanel, useUpload } from "./upload";

/** How often the list is looked at while something is being parsed, milliseconds. */
const LOOK_EVERY = 2500;

export function ScenesPlace({ onReady }: { onReady: () => void }) {
  const [scenes, setScenes] = useState<Scene[] | null>(null);
  const [next, setNext] = useState<string | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);

  const load = useCallback(async () => {
    try {
      const page = await listScenes();
      // Pages that were opened stay open.
      setScenes((old) => [...page.scenes, ...(old ?? []).filter(({ id }) => id < (page.scenes.at(-1)?.id ?? "")).filter(notIn(page.scenes))]);
      setNext((old) => old ?? page.next_cursor ?? null);
      setProblem(null);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  }, []);

  const upload = useUpload(() => void load());

  const loadMore = async () => {
    try {
      const page = await listScenes(next);
      setScenes((old) => [...(old ?? []), ...page.scenes.filter(notIn(old ?? []))]);
      setNext(page.next_cursor ?? null);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };

  useEffect(() => {
    document.title = `${t.scenes.title} · ${t.title}`;
    void load().then(onReady);
  }, []);

  const waiting = scenes?.some(({ status }) => status === "parsing") ?? false;
  useEffect(() => {
    if (!waiting) return;
    const looking = setInterval(() => void load(), LOOK_EVERY);
    return () => clearInterval(looking);
  }, [waiting]);

  const gone = (id: string) => setScenes((old) => old?.filter((scene) => scene.id !== id) ?? null);
  const changed = (scene: Scene) => setScenes((old) => old?.map((one) => (one.id === scene.id ? scene : one)) ?? null);

  return (
    <div class="place">
      {scenes?.length === 0 ? <Welcome upload={upload} /> : <h1>{t.scenes.title}</h1>}
      <UploadPanel upload={upload} withSample={scenes?.length !== 0} />
      {problem && <ProblemNote problem={problem} onAgain={() => void load()} />}
      {!scenes && !problem && <p class="wait">{t.loading}</p>}
      {scenes && scenes.length > 0 && (
        <ul class="cards">
          {scenes.map((scene) => (
            <SceneCard key={scene.id} scene={scene} onGone={gone} onChanged={changed} />
          ))}
        </ul>
      )}
      {next && (
        <button type="button" onClick={() => void loadMore()}>
          {t.more}
        </button>
      )}
    </div>
  );
}

/** What a first visit shows: what this is, and a room to try it in. */
function Welcome({ upload }: { upload: Upload }) {
  const busy = upload.step.at !== "idle";
  const { value: models } = useLoaded(() => getModels(), []);
  return (
    <section class="welcome">
      <h1>{t.title}</h1>
      <p class="lead">{t.welcome.what}</p>
      <p>
        <button type="button" class="main large" disabled={busy} onClick={() => void upload.takeSample()}>
          {t.welcome.sample}
        </button>{" "}
        <span class="small">{t.welcome.time}</span>
      </p>
      <div class="examples">
        <span>{t.welcome.ask}</span>
        {t.welcome.questions.map((question) => (
          <button type="button" key={question} class="chip" disabled={busy} onClick={() => void upload.takeSample(question)}>
            {question}
          </button>
        ))}
      </div>
      {models && <ModelsNote models={models} />}
      <h2>{t.welcome.own}</h2>
    </section>
  );
}

const notIn = (scenes: Scene[]) => (scene: Scene) => scenes.every(({ id }) => id !== scene.id);
