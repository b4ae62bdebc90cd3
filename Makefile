# `make demo` shows the whole job, `make test` passes the tests; neither needs a model, a key or another server.
CARGO ?= cargo
PYTHON ?= python3

.PHONY: demo serve test lint fmt bench openapi schemathesis clean

demo: ## Upload the sample scan to a fresh service, ask four questions, write pictures to demo-out/
	$(CARGO) build --release --locked
	./target/release/uniground demo

serve: ## Run the service on http://127.0.0.1:8080 with its data in ./data
	$(CARGO) build --release --locked
	./target/release/uniground serve

test: ## Unit tests, then a real server driven through the typed client
	$(CARGO) test --release --locked --quiet -- --show-output

lint: ## Formatting and lints; warnings are errors
	$(CARGO) fmt --check
	$(CARGO) clippy --release --locked --all-targets --quiet -- -D warnings

fmt:
	$(CARGO) fmt

bench: ## Timings of the pipelines, questions over HTTP, memory of a 1 GB upload
	$(CARGO) bench --locked

openapi: ## Regenerate the committed description
	$(CARGO) run --release --locked --quiet -- openapi > openapi/openapi.json

schemathesis: ## Property-based requests from the served description (installs Schemathesis into .venv)
	$(CARGO) build --release --locked --quiet
	PYTHON=$(PYTHON) scripts/schemathesis.sh
