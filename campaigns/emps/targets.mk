# A positioning axis. Included by the Makefile at the top.
EMPS ?= ../shared/data/emps

campaigns/emps/measurements.h5: | $(READY)
	FMUID_EMPS=$(EMPS) $(BIN)/python -m campaigns.emps.convert campaigns/emps

identify-emps: campaigns/emps/measurements.h5
	$(BIN)/fmuid identify campaigns/emps --out runs/emps

diagnose-emps: campaigns/emps/measurements.h5
	$(BIN)/fmuid diagnose campaigns/emps --out runs/emps-diagnosis
