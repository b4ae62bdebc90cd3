/** Uploads a scan that is dropped or chosen, or opens the sample, and follows it until it is ready. */

import { useEffect, useRef, useState } from "preact/hooks";
import { asProblem, wasAborted } from "../api/client";
import { sendSample } from "../api/service";
import { type Sent, uploadScan } from "../api/upload";
import type { Created, Job, Problem } from "../api/types";
import { address, go } from "../route";
import { t } from "../text";
import { ofJob, ProblemNote } from "../ui/problem";
import { say } from "../ui/say";
import { JobProgress, Progress } from "./job";

type Step =
  | { at: "idle" }
  | { at: "sending"; file: File; sent: Sent | null; started: number; stop: AbortController }
  | { at: "asking" }
  | { at: "parsing"; created: Created }
  | { at: "ready"; created: Created }
  | { at: "failed"; problem: Problem };

export type Upload = ReturnType<typeof useUpload>;

/** One scan at a time; `onCreated` is told whenever the list of scenes is no longer right. */
export function useUpload(onCreated: () => void) {
  const [step, setStep] = useState<Step>({ at: "idle" });

  const refuse = (detail: string) =>
    setStep({ at: "failed", problem: { type: "about:blank", title: t.upload.title, status: 0, detail, code: "archive_unreadable" } });

  const take = async (file: File) => {
    const stop = new AbortController();
    const sending: Step = { at: "sending", file, sent: null, started: Date.now(), stop };
    setStep(sending);
    await arrive(uploadScan(file, (sent) => setStep({ ...sending, sent }), stop.signal));
  };

  /** Opens the room of the sample at once, parsed or not, with a question to ask there. */
  const takeSample = async (question?: string) => {
    setStep({ at: "asking" });
    try {
      const { scene } = await sendSample();
      go(["scenes", scene.id], question ? { ask: question } : {});
    } catch (thrown) {
      setStep({ at: "failed", problem: asProblem(thrown) });
    }
  };

  const arrive = async (work: Promise<Created>) => {
    try {
      const created = await work;
      onCreated();
      // The same scan again is ready at once.
      setStep({ at: created.scene.status === "ready" ? "ready" : "parsing", created });
    } catch (thrown) {
      setStep(wasAborted(thrown) ? { at: "idle" } : { at: "failed", problem: asProblem(thrown) });
    }
  };

  const parsed = (created: Created, job: Job) => {
    onCreated();
    if (job.state === "succeeded") {
      say(t.upload.ready(created.scene.name));
      setStep({ at: "ready", created });
    } else if (job.error) {
      setStep({ at: "failed", problem: ofJob(job.error, t.scenes.status.failed) });
    } else {
      setStep({ at: "idle" });
    }
  };

  return { step, take, takeSample, refuse, parsed, rest: () => setStep({ at: "idle" }), fail: (problem: Problem) => setStep({ at: "failed", problem }) };
}

export function UploadPanel({ upload, withSample }: { upload: Upload; withSample: boolean }) {
  const { step, take, takeSample, refuse, parsed, rest, fail } = upload;
  const [over, setOver] = useState(false);
  const input = useRef<HTMLInputElement>(null);

  // A scan may be dropped anywhere on the page.
  useEffect(() => {
    const hover = (event: DragEvent) => {
      event.preventDefault();
      setOver(event.type === "dragover");
    };
    const drop = (event: DragEvent) => {
      event.preventDefault();
      setOver(false);
      const entry = event.dataTransfer?.items[0]?.webkitGetAsEntry?.();
      const file = event.dataTransfer?.files[0];
      if (entry?.isDirectory) refuse(t.upload.folder);
      else if (file) void take(file);
    };
    addEventListener("dragover", hover);
    addEventListener("dragleave", hover);
    addEventListener("drop", drop);
    return () => {
      removeEventListener("dragover", hover);
      removeEventListener("dragleave", hover);
      removeEventListener("drop", drop);
    };
  }, []);

  return (
    <section class="upload" data-over={over} aria-label={t.upload.title}>
      {step.at === "idle" && (
        <p>
          {t.upload.drop}{" "}
          <button type="button" class="main" onClick={() => input.current!.click()}>
            {t.upload.choose}
          </button>
          {withSample && (
            <>
              {" "}
              {t.upload.or}{" "}
              <button type="button" onClick={() => void takeSample()}>
                {t.upload.sample}
              </button>
            </>
          )}
          <span class="small">{t.upload.what}</span>
        </p>
      )}
      {step.at === "asking" && <p>{t.upload.asking}</p>}
      {step.at === "sending" && <Sending {...step} />}
      {step.at === "parsing" && step.created.job && (
        <>
          <p>
            <b>{step.created.scene.name}</b>{" "}
            <a class="button quiet" href={address(["scenes", step.created.scene.id])}>
              {t.upload.enter}
            </a>
          </p>
          <JobProgress
            job={step.created.job.id}
            onDone={(job) => parsed(step.created, job)}
            onLost={(thrown) => fail(asProblem(thrown))}
          />
        </>
      )}
      {step.at === "ready" && (
        <p>
          {t.upload.ready(step.created.scene.name)}{" "}
          <a class="button main" href={address(["scenes", step.created.scene.id])}>
            {t.upload.open}
          </a>{" "}
          <button type="button" class="quiet" onClick={rest}>
            {t.upload.dismiss}
          </button>
        </p>
      )}
      {step.at === "failed" && (
        <>
          <ProblemNote problem={step.problem} />
          <button type="button" onClick={rest}>
            {t.upload.again}
          </button>
        </>
      )}
      <input
        ref={input}
        type="file"
        class="offscreen"
        tabIndex={-1}
        aria-label={t.upload.title}
        onChange={(event) => {
          const file = event.currentTarget.files?.[0];
          event.currentTarget.value = "";
          if (file) void take(file);
        }}
      />
    </section>
  );
}

function Sending({ file, sent, started, stop }: Extract<Step, { at: "sending" }>) {
  const share = sent && sent.total ? sent.bytes / sent.total : 0;
  const left_s = share > 0.02 && share < 1 ? ((Date.now() - started) / 1000) * (1 / share - 1) : null;
  const words = share === 1 ? t.upload.checking : t.upload.sending(t.bytes(sent?.bytes ?? 0), t.bytes(file.size));
  return (
    <>
      <b>{file.name}</b>
      <div class="job">
        <Progress share={share} words={words} eta_s={left_s} />
        <button type="button" class="quiet" onClick={() => stop.abort()}>
          {t.upload.stop}
        </button>
      </div>
    </>
  );
}
