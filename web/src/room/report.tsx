/** What import and parse did with this scan. */

import { useState } from "preact/hooks";
import { asProblem } from "../api/client";
import { download } from "../api/pictures";
import { cloudPath, getReport, instancesCloudPath, nameThings, parseAgain } from "../api/service";
import type { Finding, Job, Problem, SceneReport } from "../api/types";
import { JobProgress } from "../scenes/job";
import { t } from "../text";
import { Row } from "../ui/fields";
import { useLoaded } from "../ui/load";
import { Picture } from "../ui/picture";
import { ProblemNote } from "../ui/problem";
import type { Room } from "./state";

export function ReportPanel({ room }: { room: Room }) {
  const { value: report, problem, again } = useLoaded((signal) => getReport(room.id, signal), [room.id]);
  if (problem) return <ProblemNote problem={problem} onAgain={again} />;
  if (!report) return <p class="wait">{t.loading}</p>;
  return (
    <>
      <h3>
        {t.report.title} <span class="small">{t.report.parse(report.parse_version)}</span>
      </h3>
      <Warnings report={report} />
      <Import report={report} />
      <Found report={report} />
      <Stages report={report} />
      <Actions room={room} />
      <h4>{t.report.pictures}</h4>
      {report.pictures.map(({ name, title, url }) => (
        <figure key={name}>
          <Picture path={url} alt={title} class="wide" enlarge />
          <figcaption class="small">{title}</figcaption>
        </figure>
      ))}
    </>
  );
}

function Warnings({ report }: { report: SceneReport }) {
  const warnings = [...(report.import?.warnings ?? []), ...(report.parse?.warnings ?? [])];
  return warnings.length === 0 ? null : (
    <div class="warn">
      <h4>{t.report.warnings}</h4>
      <ul>
        {warnings.map((warning) => (
          <li key={warning}>{warning}</li>
        ))}
      </ul>
    </div>
  );
}

function Import({ report: { import: found, parse } }: { report: SceneReport }) {
  if (!found) return null;
  const agreement = found.reprojection_agreement;
  return (
    <section>
      <h4>{t.report.import}</h4>
      <dl class="fields">
        <Row term={t.report.format}>{found.format}</Row>
        <Row term={t.report.frames}>
          {found.frames}
          {found.frames_skipped > 0 && ` (${t.report.skipped(found.frames_skipped)})`}
        </Row>
        <Row term={t.report.cloud}>
          {t.scenes.points(parse?.points ?? found.cloud_points ?? 0)}
          {found.cloud_points == null && `, ${t.report.fused}`}
        </Row>
        <Row term={t.report.up}>{found.up}</Row>
        <Row term={t.report.pose}>{found.pose.replace(/_/g, " ")}</Row>
        <Row term={t.report.axes}>{found.camera_axes}</Row>
        {agreement != null && <Row term={t.report.agreement}>{Math.round(agreement * 100)} %</Row>}
      </dl>
      <Findings findings={found.findings ?? []} />
    </section>
  );
}

/** What the import read, left out and assumed. Warnings are shown above. */
function Findings({ findings }: { findings: Finding[] }) {
  const quiet = findings.filter((finding) => !finding.warning);
  return quiet.length === 0 ? null : (
    <details>
      <summary>{t.report.findings(quiet.length)}</summary>
      <ul>
        {quiet.map(({ kind, text, confidence }) => (
          <li key={text}>
            <b>{t.report.finding[kind]}</b>: {text}
            {confidence != null && ` (${t.report.confidence(confidence)})`}
          </li>
        ))}
      </ul>
    </details>
  );
}

function Found({ report: { parse, models } }: { report: SceneReport }) {
  if (!parse) return null;
  return (
    <section>
      <h4>{t.report.found}</h4>
      <dl class="fields">
        <Row term={t.report.instances}>{`${parse.instances} (${parse.structural} ${t.report.building})`}</Row>
        <Row term={t.report.partsAndWholes}>{parse.parts_and_wholes}</Row>
        <Row term={t.report.superpoints}>{parse.superpoints.toLocaleString("en")}</Row>
        <Row term={t.report.dropped}>{(parse.dropped ?? 0) + (parse.specks ?? 0)}</Row>
        <Row term={t.report.withoutViews}>{parse.without_views}</Row>
        {models && (
          <Row term={t.report.models}>
            <code>{models.masks}</code>, <code>{models.encoder}</code>
          </Row>
        )}
      </dl>
    </section>
  );
}

function Stages({ report: { parse } }: { report: SceneReport }) {
  if (!parse) return null;
  return (
    <section>
      <h4>{t.report.stages}</h4>
      <table class="figures">
        <thead>
          <tr>
            <th scope="col">{t.report.stage}</th>
            <th scope="col" class="right">
              {t.report.seconds}
            </th>
            <th scope="col" class="right">
              {t.report.produced}
            </th>
            <th scope="col" class="right">
              {t.report.memory}
            </th>
          </tr>
        </thead>
        <tbody>
          {parse.stages.flatMap((stage) => [
            <tr key={stage.stage}>
              <th scope="row">{t.stages[stage.stage] ?? stage.stage}</th>
              <td class="right">{stage.reused ? t.report.reused : stage.seconds.toFixed(2)}</td>
              <td class="right">{(stage.produced ?? 0).toLocaleString("en")}</td>
              <td class="right">{stage.peak_memory_mb == null ? "" : `${stage.peak_memory_mb} MB`}</td>
            </tr>,
            ...(stage.models ?? []).map(({ network, inputs, seconds }) => (
              <tr key={`${stage.stage} ${network}`} class="small">
                <td>{t.report.networks[network]}</td>
                <td class="right">{seconds.toFixed(2)}</td>
                <td class="right">{`${inputs.toLocaleString("en")} ${t.report.inputs[network]}`}</td>
                <td />
              </tr>
            )),
          ])}
        </tbody>
      </table>
    </section>
  );
}

function Actions({ room }: { room: Room }) {
  const [job, setJob] = useState<Job | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const attempt = (work: Promise<unknown>) => void work.catch((thrown) => setProblem(asProblem(thrown)));
  const done = (ended: Job) => {
    if (ended.state === "succeeded") location.reload();
    else setJob(null);
  };
  return (
    <section>
      <div class="buttons">
        <button type="button" onClick={() => attempt(download(cloudPath(room.id), "cloud.ply"))}>
          {t.report.downloads} {t.report.cloudFile}
        </button>
        <button type="button" onClick={() => attempt(download(instancesCloudPath(room.id), "instances.ply"))}>
          {t.report.instancesFile}
        </button>
        <button type="button" disabled={job !== null} onClick={() => attempt(parseAgain(room.id).then(setJob))}>
          {t.report.again}
        </button>
        {room.models.value?.vlm != null && (
          <button type="button" disabled={job !== null} onClick={() => attempt(nameThings(room.id).then(setJob))}>
            {t.report.name}
          </button>
        )}
      </div>
      {job && <JobProgress job={job.id} onDone={done} />}
      {problem && <ProblemNote problem={problem} />}
    </section>
  );
}
