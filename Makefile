# Every target sets itself up: a virtual environment in .venv; what runs has the versions of requirements-run.lock,
# what tests and documents it those of requirements.lock beside them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := $(VENV)/.run
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
MINUTES ?= 30
SEED ?= 1
INPUTS ?= 1000000

PREFIX ?= /usr/local
SYSCONFDIR ?= /etc
override DESTDIR := $(patsubst %/,%,$(DESTDIR))
LIB := $(PREFIX)/lib/rtec
UNITS := $(PREFIX)/lib/systemd/system

.PHONY: linuxcnc studio box gateware coverage mutants install check-paths install-venv install-files uninstall help demo test lint check bench soak attack fuzz discovery proof docs reference figures lock format clean
help:  ## what can be made
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

$(RUN): requirements-run.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || \
	  { echo "rtec needs Python 3.11 to 3.13; $(PYTHON) is $$($(PYTHON) --version 2>&1). Try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "python cannot make virtual environments here. On Debian and Ubuntu: apt-get install python3-venv"; exit 2; }
	$(PIP) --require-hashes -r requirements-run.lock
	$(PIP) --no-deps --no-build-isolation --editable .
	@touch $@

$(STAMP): $(RUN) requirements.lock
	$(PIP) --require-hashes -r requirements.lock
	@touch $@

demo: $(RUN)  ## a machine warms up for a day, uncorrected and corrected; writes out/demo
	$(BIN)/rtec demo

# A test on the real clock may fail beside others on a busy PC: its file is judged once more, alone, from its beginning,
# as the tests of a story go on from each other.
FAILED := import json; print(*sorted({t.partition("::")[0] for t in json.load(open(".pytest_cache/v/cache/lastfailed"))}))
test: $(STAMP)  ## the tests
	$(BIN)/python -m pytest -n auto --dist loadgroup || \
	  { [ $$? -eq 1 ] && files=$$($(BIN)/python -c '$(FAILED)') && [ -n "$$files" ] && $(BIN)/python -m pytest --exitfirst $$files; }

lint: $(STAMP)  ## format, lint, types, import layers
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: lint test  ## all of it: lint, then the tests

BENCHES := boxlink cycle diagnose disturb fit logs quadrature startup wakeup
ifneq (,$(filter bench,$(MAKECMDGOALS)))
PARTS := $(filter $(BENCHES),$(MAKECMDGOALS))
.PHONY: $(PARTS)
$(PARTS): bench
	@:
endif

bench: $(STAMP)  ## speed, each figure beside what it is measured against; bench disturb: this part only
	$(BIN)/python -m tests.bench $(PARTS)

soak: $(RUN)  ## half an hour against simulated hardware with faults by chance; MINUTES=, SEED=, SHARED=--shared
	$(BIN)/rtec hil configs/hil.toml --soak $(MINUTES) --seed $(SEED) $(SHARED) --report out/soak

attack: $(STAMP)  ## ten minutes of kills, faults, hostile clients and spoilt files; fails on any loss; MINUTES=
	$(BIN)/python -m tests.attack $(if $(filter file,$(origin MINUTES)),10,$(MINUTES))

fuzz: $(STAMP)  ## a million spoilt inputs for every reader of text from outside; INPUTS=, SEED=
	$(BIN)/python -m tests.fuzz $(INPUTS) $(SEED)

discovery: $(STAMP)  ## effects hidden in simulated measurements, and how many are found; half an hour
	$(BIN)/python -m tests.discovery
	$(BIN)/rtec bench discovery --seeds 1000:1006 --jobs 2

proof: $(STAMP)  ## the ball bar's diagnosis of some 1600 random machines; all seeds of the tests that have many
	$(BIN)/python -m tests.ball_bar.ball_bar_proof
	RTEC_WHOLE_PROOF=1 $(BIN)/python -m pytest -n auto --dist loadgroup tests/diagnosis tests/characterise tests/estimation tests/ball_bar \
	  tests/metrology/test_grid_encoder.py tests/real/test_real_fit.py tests/discovery/test_discovery.py \
	  tests/sim/test_campaign.py tests/commission/test_wheel.py tests/daemon/test_ring.py tests/hil/test_kill.py

reference: $(STAMP)  ## the page of all keys, off the models that check the files
	$(BIN)/rtec explain --all > docs/reference/keys.md

docs: $(STAMP)  ## the documentation as a site in out/docs, readable without a network
	$(BIN)/python -m tests.site.build out/docs

figures: $(STAMP)  ## the figures of the documentation, made by the demo and by the commands of the tutorial
	$(BIN)/rtec demo --no-hidden --out out/figures
	cp out/figures/diameter.png docs/figures/demo-diameter.png
	$(BIN)/python -m tests.tutorial.tutorial docs/figures
	$(BIN)/python -m tests.notebooks.run
	$(BIN)/python -m tests.tutorial.campaign docs/figures
	$(BIN)/python -m tests.studio.screens docs/figures
	$(BIN)/python drivers/box/boards/wiring.py
	$(BIN)/python -m tests.telemetry.pictures docs/figures

linuxcnc: $(STAMP)  ## a mill that LinuxCNC runs: measured, fitted, diagnosed, corrected; some minutes; writes out/linuxcnc
	$(BIN)/python -m tests.tutorial.linuxcnc out/linuxcnc

studio: $(STAMP)  ## compare, diagnose and improve in the browser; opens out/studio
	@mkdir -p out/studio
	$(BIN)/rtec studio out/studio

box:  ## the encoder box's gateware: its simulation, its proofs and the bitstreams of the boards
	$(MAKE) -C drivers/box sim proof synth

gateware: $(STAMP)  ## the box driver's suites and those of rtec hil, all on the simulated gateware; four minutes
	RTEC_WHOLE_GATEWARE=1 $(BIN)/python -m pytest -n 0 tests/box tests/drivers/test_serial_box.py \
	  tests/drivers/test_serial_box_pty.py tests/drivers/test_box_in_the_loop.py tests/hil/test_hil.py

coverage: $(STAMP)  ## lines, branches and toggles of the gateware that its tests cover; fails below 95 %
	rm -rf out/coverage && mkdir -p out/coverage
	RTEC_GATEWARE_COVERAGE=out/coverage $(BIN)/python -m pytest -q -n 0 tests/box/test_gateware_lines.py \
	  tests/box/test_gateware_link.py tests/box/test_gateware_ranges.py
	$(BIN)/python drivers/box/sim/coverage.py out/coverage

mutants: $(STAMP)  ## the gateware broken in eighteen places, one at a time: a test must notice each; three minutes
	$(BIN)/python drivers/box/sim/mutants.py

format: $(STAMP)  ## rewrite the code in the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

LOCK := $(BIN)/uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes --no-header \
  --no-annotate --quiet
lock: $(STAMP)  ## resolve both locks again from pyproject.toml
	$(LOCK) --group dev --upgrade --output-file requirements.lock
	$(LOCK) --group build --constraint requirements.lock --output-file requirements-run.lock

install: install-venv install-files  ## the daemon as a service, for root; PREFIX (/usr/local) and DESTDIR as usual
	@echo "installed; now see $(PREFIX)/share/doc/rtec/service.md"

# Whatever root's own mask is: the service's user must be able to read what is installed.
install install-venv install-files: .SHELLFLAGS := -c 'umask 022; eval "$$0"'

# Other paths would hit files that are not meant, when they are removed, too.
check-paths:
	@[ $(words x$(DESTDIR)x$(PREFIX)x$(SYSCONFDIR)) -eq 1 ] || { echo "DESTDIR, PREFIX and SYSCONFDIR must have no spaces"; exit 2; }
	@case "$(DESTDIR)/:$(PREFIX):$(SYSCONFDIR)" in /*:/*:/*) ;; *) \
	  echo "DESTDIR, PREFIX and SYSCONFDIR must be whole paths, beginning with /"; exit 2;; esac

# A virtual environment of its own; the service's user must reach the Python that it is made of.
install-venv: check-paths
	@case "$$(realpath "$$(command -v $(PYTHON))")" in /root/*|/home/*) [ -n "$(ANY_PYTHON)" ] || \
	  { echo "the service's user cannot reach $$(realpath "$$(command -v $(PYTHON))"). Try: make install PYTHON=/usr/bin/python3"; exit 2; };; esac
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || \
	  { echo "rtec needs Python 3.11 to 3.13. Try: make install PYTHON=/usr/bin/python3.12"; exit 2; }
	install -d $(DESTDIR)$(LIB)
	$(PYTHON) -m venv --clear $(DESTDIR)$(LIB)
	$(DESTDIR)$(LIB)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-run.lock
	rm -rf build
	$(DESTDIR)$(LIB)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps .
	rm -rf build
	[ -z "$(DESTDIR)" ] || sed -i 's|$(DESTDIR)$(LIB)|$(LIB)|g' $$(grep -lIF '$(DESTDIR)$(LIB)' $(DESTDIR)$(LIB)/pyvenv.cfg $(DESTDIR)$(LIB)/bin/*)
	install -d $(DESTDIR)$(PREFIX)/bin
	ln -sf $(LIB)/bin/rtec $(DESTDIR)$(PREFIX)/bin/rtec
	install -d $(DESTDIR)$(PREFIX)/share/bash-completion/completions
	_RTEC_COMPLETE=source_bash $(DESTDIR)$(LIB)/bin/python -m rtec.cli.main \
	  > $(DESTDIR)$(PREFIX)/share/bash-completion/completions/rtec

install-files: check-paths
	install -d $(DESTDIR)$(UNITS) $(DESTDIR)$(PREFIX)/lib/sysusers.d $(DESTDIR)$(SYSCONFDIR)/udev/rules.d \
	  $(DESTDIR)$(PREFIX)/share/doc/rtec $(DESTDIR)$(SYSCONFDIR)/rtec
	for unit in rtec@ rtec-telemetry@; do sed -e 's|@PREFIX@|$(PREFIX)|g; s|@SYSCONFDIR@|$(SYSCONFDIR)|g' \
	  systemd/$$unit.service.in > $(DESTDIR)$(UNITS)/$$unit.service || exit 1; done
	install -m 644 systemd/rtec.sysusers $(DESTDIR)$(PREFIX)/lib/sysusers.d/rtec.conf
	install -m 644 systemd/70-rtec.rules $(DESTDIR)$(SYSCONFDIR)/udev/rules.d/70-rtec.rules
	install -m 644 systemd/network.conf docs/service.md docs/runbook.md docs/telemetry.md $(DESTDIR)$(PREFIX)/share/doc/rtec
	cd configs && find machines models sim turning-centre-sim.toml -name '*.toml' | while read -r f; do \
	  to="$(DESTDIR)$(SYSCONFDIR)/rtec/$$f"; [ -e "$$to" ] || { install -D -m 644 "$$f" "$$to" && sed -i '/^log_folder = /d' "$$to"; } || exit 1; done
	[ -n "$(DESTDIR)" ] || [ ! -d /run/systemd/system ] || { systemd-sysusers && systemctl daemon-reload && udevadm control --reload; }

uninstall: check-paths  ## remove what make install made; configurations, state and logs stay
	[ -n "$(DESTDIR)" ] || [ ! -d /run/systemd/system ] || { systemctl stop 'rtec@*.service' 'rtec-telemetry@*.service'; \
	  for link in /etc/systemd/system/*.wants/rtec@*.service /etc/systemd/system/*.wants/rtec-telemetry@*.service; do [ ! -h "$$link" ] || systemctl disable "$$(basename "$$link")"; done; }
	rm -rf $(DESTDIR)$(LIB) $(DESTDIR)$(PREFIX)/share/doc/rtec
	rm -f $(DESTDIR)$(PREFIX)/bin/rtec $(DESTDIR)$(PREFIX)/share/bash-completion/completions/rtec \
	  $(DESTDIR)$(UNITS)/rtec@.service $(DESTDIR)$(UNITS)/rtec-telemetry@.service $(DESTDIR)$(PREFIX)/lib/sysusers.d/rtec.conf \
	  $(DESTDIR)$(SYSCONFDIR)/udev/rules.d/70-rtec.rules
	[ -n "$(DESTDIR)" ] || [ ! -d /run/systemd/system ] || { systemctl daemon-reload && udevadm control --reload; }
	@echo "$(SYSCONFDIR)/rtec, /var/lib/rtec, /var/log/rtec and the user rtec stay; remove them by hand"

clean:  ## remove the virtual environment and what tools leave behind
	rm -rf $(VENV) build *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache
