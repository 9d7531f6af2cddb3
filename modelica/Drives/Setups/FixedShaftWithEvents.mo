within Drives.Setups;
model FixedShaftWithEvents "Output shaft locked, motor current given; the gear sticks and slides by events"
  extends FixedShaft(redeclare model GearModel = Components.EventHarmonicDrive);
end FixedShaftWithEvents;
