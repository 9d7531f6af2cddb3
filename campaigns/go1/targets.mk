# A servo on a pendulum bench. Included by the Makefile at the top.
GO1 ?= ../shared/data/go1

campaigns/go1/measurements.h5: | $(READY)
	FMUID_GO1=$(GO1) $(BIN)/python -m campaigns.go1.convert campaigns/go1

# Then compare the friction laws on the runs used and on those reserved for validation.
identify-go1: $(PENDULUM) campaigns/go1/measurements.h5
	$(BIN)/fmuid identify campaigns/go1 --out runs/go1
	$(BIN)/python -m benchmarks.rival_stages runs/go1 q "M?"
	$(BIN)/python -m benchmarks.rival_stages runs/go1 q "M?_absolute"

diagnose-go1: $(PENDULUM) campaigns/go1/measurements.h5
	$(BIN)/fmuid diagnose campaigns/go1 --out runs/go1-diagnosis
