# The paper reproduced. Included by the Makefile at the top.
# The paper's experiments and searches without derivatives, then least squares; writes docs/tutorials/paper.md.
campaigns/paper/measurements.h5: $(FORCE_FEEDBACK)/rig.toml benchmarks/paper_reproduced/recorded.py $(RIG) | $(READY)
	$(BIN)/python -m benchmarks.paper_reproduced measurements

paper: build/fmus/FreeShaft.fmu build/fmus/EccentricLoad.fmu campaigns/paper/measurements.h5
	$(BIN)/fmuid identify campaigns/paper --out runs/paper/direct
	$(BIN)/fmuid identify campaigns/paper --solver auto --out runs/paper/least_squares --no-report
	$(BIN)/python -m benchmarks.paper_reproduced page runs/paper/direct runs/paper/least_squares
	$(BIN)/python -m benchmarks.multibody_load
