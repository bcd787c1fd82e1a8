# make demo    a simulated stage on the running graph: demo_report/index.html
# make test    the checks and the tests
# make docs    the documentation site: build/site/index.html
#
# Each makes its own virtual environment from a bare Python: make PYTHON=python3.12 test

PYTHON ?= python3
PYTEST_ARGS ?=

# any of these changed: install again
DECLARED := setup.py setup.cfg pyproject.toml

# rclpy comes from the wheels, or from a ROS installation that is sourced, and never from both: the
# environment is made anew where that has changed
SOURCED := $(or $(ROS_DISTRO),$(AMENT_PREFIX_PATH))
MADE := .venv/.made$(if $(SOURCED),-sourced)

.PHONY: any-record attack bouc-wen coverage docs netns soak
.PHONY: demo test lint test-graph test-jazzy bench bench-live study-identification colcon
.PHONY: crash limits mirror stays-right study study-xy table-one clean distclean
.DELETE_ON_ERROR:

demo: .venv/.demo
	.venv/bin/python examples/demo.py --out demo_report

# the tests that mostly compute, with mypy beside them, those of node processes, then, one after the
# other, what loads the machine and what judges seconds; the slowest files start first.  A file of
# the first stays in one process.  The middleware may end a process of the second, and only
# `worksteal` goes on then: `loadfile` waits for ever
PARALLEL := -n 2 -m 'not timed and not loads'
FILES := --dist loadfile --no-loadscope-reorder
ALONE := -m 'timed or loads' test/nodes

test: .venv/.test
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy & types=$$!; \
	.venv/bin/pytest $(PARALLEL) $(FILES) --ignore=test/nodes $(PYTEST_ARGS); rc=$$?; wait $$types && exit $$rc
	.venv/bin/pytest $(PARALLEL) --dist worksteal test/nodes $(PYTEST_ARGS)
	.venv/bin/pytest $(ALONE) $(PYTEST_ARGS)

lint: .venv/.test
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

# node processes over DDS alone
test-graph: .venv/.test
	.venv/bin/pytest test/nodes $(PYTEST_ARGS)

# the same tests on the versions that Jazzy stands on
test-jazzy: .venv-jazzy/.test
	.venv-jazzy/bin/pytest -p no:cacheprovider --ignore=test/nodes $(PYTEST_ARGS)

# a warning is an error; test/house/test_site.py builds it the same way
docs: .venv-docs/.docs
	.venv-docs/bin/sphinx-build -q -W --keep-going -b html docs build/site
	@echo build/site/index.html

# side by side with the peers, in an environment of their own: forty minutes to over an hour;
# QUICK=1 for a short version, which goes to build/
bench: .venv-bench/.bench
	.venv-bench/bin/python benchmarks/run_all.py \
		$(if $(QUICK),--quick --out build/benchmarks.md,--out docs/benchmarks.md)

# the running graph in real time, 20 kHz for so many seconds, and faster; then blocks of all sizes,
# and how many stages this machine carries: about a quarter of an hour
BENCH_SECONDS ?= 300
bench-live: .venv/.demo
	.venv/bin/python benchmarks/bench_live.py --seconds $(BENCH_SECONDS) --out docs/live.md

# twenty seeds, three noise levels, stages on and off the grid: about five minutes
study-identification: .venv/.demo
	.venv/bin/python benchmarks/study_identification.py docs/identification_study.md

# how near stages come to wanted motions, with and without what a diagnosis finds: ten minutes
track: .venv/.demo
	.venv/bin/python benchmarks/study_tracking.py docs/tracking.md \
	    --picture docs/images/tracking.png

# how well the raster of a simulated scanner is predicted and tracked: ten minutes
study-xy: .venv/.demo
	.venv/bin/python benchmarks/xy_scanner.py docs/xy_study.md --picture docs/images/xy_study.png

# what a measured fast steering mirror has and a linear model lacks: under ten minutes; the records
# are read from ../shared/data/fsm, or from fsm in PIEZO_IDENT_DATA
mirror: .venv/.demo
	.venv/bin/python benchmarks/study_mirror.py docs/mirror.md --pictures docs/images

# whether bands, promises, deviations and weights hold: at most three hours of processor time; goes
# on where it was stopped; QUICK=1 for some minutes, which goes to build/
coverage: .venv/.demo
	.venv/bin/python benchmarks/study_coverage.py $(if $(QUICK),build/coverage.md --identified 6 \
	    --diagnosed 1 --draws 2 --picture build/images/coverage.png,docs/coverage.md)

# how often a diagnosis is right, on stages that are sums of plays and on others: hours on two
# cores; goes on where it was stopped; SAMPLE=60 for so many cases of each, drawn at random
STUDY = .venv/bin/python benchmarks/study_diagnosis.py $(if $(SAMPLE),--sample $(SAMPLE))
study: .venv/.demo
	$(STUDY) docs/diagnosis_study.md
	$(STUDY) --set next docs/diagnosis_study_foreign.md

# what docs/reliability.md says, run again; then the page is made of what came out
RUN_STUDY = .venv/bin/python benchmarks/reliability
attack: .venv/.test
	$(RUN_STUDY)/safety.py --count 100000
	$(RUN_STUDY)/attack.py
	$(RUN_STUDY)/build.py

# two hosts as network namespaces; says why when there can be none (root, ip and nft are needed)
netns: .venv/.test
	$(RUN_STUDY)/netns.py
	$(RUN_STUDY)/build.py

# the whole graph in real time for two hours
SECONDS ?= 7200
soak: .venv/.test
	$(RUN_STUDY)/soak.py --seconds $(SECONDS)
	$(RUN_STUDY)/build.py

# unlabelled records of seventeen kinds beside four simple peers, about an hour
any-record: .venv/.demo
	.venv/bin/python benchmarks/any_record.py docs/any_record.md

# hysteresis inside the loop of the mechanics, on three springs and their linear models: some
# minutes
bouc-wen: .venv/.demo
	.venv/bin/python benchmarks/bouc_wen.py docs/bouc_wen.md \
	    --picture docs/images/bouc_wen.png

# what the live model makes of stages that change while they scan: some minutes
stays-right: .venv/.demo
	.venv/bin/python benchmarks/stays_right.py docs/stays_right.md \
	    --picture docs/images/stays_right.png

# Table I of the paper with a third row: some minutes
table-one: .venv/.demo
	.venv/bin/python benchmarks/table_one.py docs/table_one.md

# every command killed while it works, on full and on read-only disks: some minutes, best as root
crash: .venv/.test
	.venv/bin/python benchmarks/reliability/crash.py
	$(RUN_STUDY)/build.py

# no voltage of the inverse leaves its limits, in 10,000 random references: some minutes
limits: .venv/.test
	REFERENCES=10000 .venv/bin/pytest test/control/whole/test_inverse_properties.py -k limits_are_kept

# what a ROS workspace would do, without ROS; and every node starts from there
colcon: .venv/.colcon
	.venv/bin/colcon build --packages-select piezo_ident
	test -x install/piezo_ident/lib/piezo_ident/piezo_ident
	test -f install/piezo_ident/share/piezo_ident/package.xml
	test -f install/piezo_ident/share/ament_index/resource_index/packages/piezo_ident
	bash -c '. .venv/bin/activate && . install/setup.bash && python .ci/installed_nodes.py install/piezo_ident'

# one environment, more of it as it is asked for
.venv/.demo: EXTRAS := $(if $(SOURCED),,[ros])
.venv/.test: EXTRAS := $(if $(SOURCED),[test],[ros,test,fmu])
.venv/.colcon: EXTRAS := $(if $(SOURCED),[colcon],[colcon,ros])
.venv-jazzy/.test: EXTRAS := [test]
.venv-bench/.bench: EXTRAS := [bench]
.venv-docs/.docs: EXTRAS := [docs]
.venv-jazzy/.test: CONSTRAINTS := -c constraints-jazzy.txt

.venv-jazzy/.test: constraints-jazzy.txt

.venv/.made .venv-jazzy/.made .venv-bench/.made .venv-docs/.made:
	$(PYTHON) -m venv --clear $(@D)
	touch $@

# what ROS stands on is among the packages of the system, and built for NumPy 1
.venv/.made-sourced:
	@echo 'ROS is sourced ($(SOURCED)): rclpy is taken from there, by PYTHONPATH and'
	@echo '--system-site-packages; the ROS wheels are not installed'
	$(PYTHON) -m venv --clear --system-site-packages $(@D)
	touch $@

INSTALL = .venv/bin/pip install --quiet --disable-pip-version-check $(if $(SOURCED),'numpy<2')

# the demo goes on without nodes; the stamp keeps it from asking for the wheels each time
.venv/.demo: $(MADE) $(DECLARED)
	@$(INSTALL) -e ".$(EXTRAS)" || { $(INSTALL) -e . && \
	echo 'no ROS wheels for this machine, see above: installed without them, so the nodes cannot' && \
	echo 'run; to ask for the wheels again: rm .venv/.demo'; }
	touch $@

.venv/.test .venv/.colcon: $(MADE) $(DECLARED)
	$(INSTALL) -e ".$(EXTRAS)"
	touch $@

.venv-jazzy/.test: .venv-jazzy/.made $(DECLARED)
	.venv-jazzy/bin/pip install --quiet --disable-pip-version-check $(CONSTRAINTS) -e ".$(EXTRAS)"
	touch $@

.venv-bench/.bench: .venv-bench/.made $(DECLARED)
	.venv-bench/bin/pip install --quiet --disable-pip-version-check -e ".$(EXTRAS)"
	touch $@

.venv-docs/.docs: .venv-docs/.made $(DECLARED)
	.venv-docs/bin/pip install --quiet --disable-pip-version-check -e ".$(EXTRAS)"
	touch $@

clean:
	rm -rf build install log dist demo_report *.egg-info
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name .venv\* -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean
	rm -rf .venv .venv-jazzy .venv-bench .venv-docs
