# A robot with two encoders. Included by the Makefile at the top.
ROBOT ?= ../shared/data/robot_identification

campaigns/robot/measurements.h5: | $(READY)
	FMUID_ROBOT=$(ROBOT) $(BIN)/python -m campaigns.robot.convert campaigns/robot

identify-robot: campaigns/robot/measurements.h5
	$(BIN)/fmuid identify campaigns/robot --out runs/robot
	$(BIN)/python -m benchmarks.beside_published runs/robot authors
	FMUID_ROBOT=$(ROBOT) $(BIN)/python -m campaigns.robot.encoders runs/robot

# From the start values, because the delay that the last stage finds is not in the model yet.
diagnose-robot: campaigns/robot/measurements.h5
	$(BIN)/fmuid diagnose campaigns/robot --out runs/robot-diagnosis
