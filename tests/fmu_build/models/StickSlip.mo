package StickSlip "Trains with friction by events"
  model Brake "Inertia under a torque, held by friction"
    input Drives.Types.Torque drive;
    output Drives.Types.Angle phi = inertia.phi;
    output Drives.Types.AngularVelocity w = inertia.w;
    Drives.Components.Inertia inertia(J = 0.1, phi(fixed = true), w(fixed = true));
    Drives.Components.BearingFriction friction(tau_c = 2, b = 0.5);
    Drives.Components.Fixed frame;
    Drives.Components.Torque torque;
  equation
    torque.tau = drive;
    connect(torque.flange, inertia.flange_a);
    connect(inertia.flange_b, friction.flange_b);
    connect(friction.flange_a, frame.flange);
  end Brake;

  model Geared "Two inertias, rigidly on a lossy gear"
    Drives.Components.Inertia a(J = 0.01);
    Drives.Components.LossyGear gear(ratio = 5, lossTable = [0, 0.8, 0.7, 0.1, 0.1]);
    Drives.Components.Inertia b(J = 1, phi(fixed = true, stateSelect = StateSelect.always),
      w(fixed = true, stateSelect = StateSelect.always));
    Drives.Components.Torque left;
    Drives.Components.Torque right;
    input Drives.Types.Torque u;
    input Drives.Types.Torque load;
    output Drives.Types.AngularVelocity w_a = gear.w_a;
    output Real lossEnergy(unit = "J", start = 0, fixed = true);
  equation
    left.tau = u;
    right.tau = load;
    connect(left.flange, a.flange_a);
    connect(a.flange_b, gear.flange_a);
    connect(gear.flange_b, b.flange_a);
    connect(b.flange_b, right.flange);
    der(lossEnergy) = gear.lossPower;
  end Geared;
end StickSlip;
