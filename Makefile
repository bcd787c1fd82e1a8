# make demo    the lab graph on a simulated stage, identified from nothing: demo_report/
# make test    the checks and the tests
#
# Each makes its own virtual environment from a bare Python: make PYTHON=python3.12 test

PYTHON ?= python3
PYTEST_ARGS ?=

# any of these changed: install again
DECLARED := setup.py setup.cfg pyproject.toml

.PHONY: demo test lint pytest test-graph test-jazzy bench bench-live study-identification colcon
.PHONY: study table-one clean distclean
.DELETE_ON_ERROR:

demo: .venv/.demo
	.venv/bin/piezo_ident demo --out demo_report

test: lint pytest

lint: .venv/.test
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

pytest: .venv/.test
	.venv/bin/pytest --ignore=test/nodes $(PYTEST_ARGS)

# node processes over DDS; they mind what else the machine is doing
test-graph: .venv/.graph
	.venv/bin/pytest test/nodes $(PYTEST_ARGS)

# the same tests on the versions that Jazzy stands on
test-jazzy: .venv-jazzy/.test
	.venv-jazzy/bin/pytest -p no:cacheprovider --ignore=test/nodes $(PYTEST_ARGS)

bench: .venv/.demo
	.venv/bin/python benchmarks/bench_prediction.py

# the running graph in real time, 20 kHz for so many seconds, and faster
BENCH_SECONDS ?= 300
bench-live: .venv/.demo
	.venv/bin/python benchmarks/bench_live.py --seconds $(BENCH_SECONDS) --out docs/live.md

# twenty seeds, three noise levels, stages on and off the grid: about five minutes
study-identification: .venv/.demo
	.venv/bin/python benchmarks/study_identification.py docs/identification_study.md

# how often a diagnosis is right: hours on two cores; goes on where it was stopped
study: .venv/.demo
	.venv/bin/python benchmarks/study_diagnosis.py docs/diagnosis_study.md

# Table I of the paper with a third row: about a minute
table-one: .venv/.demo
	.venv/bin/python benchmarks/table_one.py docs/table_one.md

# what a ROS workspace would do, without ROS; and every node starts from there
colcon: .venv/.colcon
	.venv/bin/colcon build --packages-select piezo_ident
	test -x install/piezo_ident/lib/piezo_ident/piezo_ident
	test -f install/piezo_ident/share/piezo_ident/package.xml
	test -f install/piezo_ident/share/ament_index/resource_index/packages/piezo_ident
	bash -c '. install/setup.bash && .venv/bin/python .ci/installed_nodes.py install/piezo_ident'

# one environment, more of it as it is asked for
.venv/.demo: EXTRAS := [ros]
.venv/.test: EXTRAS := [test]
.venv/.graph: EXTRAS := [ros,test]
.venv/.colcon: EXTRAS := [colcon,ros]
.venv-jazzy/.test: EXTRAS := [test]
.venv-jazzy/.test: CONSTRAINTS := -c constraints-jazzy.txt

.venv-jazzy/.test: constraints-jazzy.txt

.venv/.made .venv-jazzy/.made:
	$(PYTHON) -m venv --clear $(@D)
	touch $@

.venv/.demo .venv/.test .venv/.graph .venv/.colcon: .venv/.made $(DECLARED)
	.venv/bin/pip install --quiet --disable-pip-version-check -e ".$(EXTRAS)"
	touch $@

.venv-jazzy/.test: .venv-jazzy/.made $(DECLARED)
	.venv-jazzy/bin/pip install --quiet --disable-pip-version-check $(CONSTRAINTS) -e ".$(EXTRAS)"
	touch $@

clean:
	rm -rf build install log dist demo_report *.egg-info
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name .venv\* -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean
	rm -rf .venv .venv-jazzy
