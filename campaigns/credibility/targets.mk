# DLR's calibration example. Included by the Makefile at the top.
# A clone of DLR's library Credibility; MSL is one of the Modelica Standard Library.
CREDIBILITY ?= ../Credibility

campaigns/credibility/measurements.h5: | $(READY)
	FMUID_CREDIBILITY=$(CREDIBILITY) $(BIN)/python -m campaigns.credibility.convert campaigns/credibility

DRIVE := SimpleControlledDrive_virtualMeasurement
DRIVES := Credibility/Examples/SimpleControlledDriveNonlinear
build/fmus/$(DRIVE).fmu: | $(READY)
	$(BIN)/fmuid build $(CREDIBILITY)/$(DRIVES)/$(DRIVE).mo $(subst /,.,$(DRIVES)).$(DRIVE) \
	  --root $(CREDIBILITY) --root $(MSL) --out $(@D)

# DLR's calibration example: the library's own model and table.
identify-credibility: build/fmus/$(DRIVE).fmu campaigns/credibility/measurements.h5
	$(BIN)/fmuid identify campaigns/credibility --out runs/credibility
